"""Where a rig's cameras see points of the ego frame."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

LEAST_DEPTH_M = 0.1  # nearer points are behind the camera or on its lens


class Projection(NamedTuple):
    """Points as the cameras see them."""

    places: Tensor  # (B, N, ..., 2) x right, y down, as shares of the image; far outside if behind the camera
    seen: Tensor  # (B, N, ...) bool: inside the image


@dataclass(frozen=True)
class CameraRig:
    """The N cameras of each of B samples. An image's first pixel has its centre at 0.5 pixels."""

    intrinsics: Tensor  # (B, N, 3, 3) in pixels of the images that the model is given
    ego_from_camera: Tensor  # (B, N, 4, 4) camera: x right, y down, z forward; metres

    def to(self, device: torch.device | str) -> "CameraRig":
        """The same on a device."""
        return CameraRig(self.intrinsics.to(device), self.ego_from_camera.to(device))

    def resized(self, width_factor: float, height_factor: float) -> "CameraRig":
        """The rig of images that were resized by these factors."""
        factors = self.intrinsics.new_tensor([width_factor, height_factor, 1.0])
        return CameraRig(self.intrinsics * factors[:, None], self.ego_from_camera)

    def augmented(self, augmentations: Tensor) -> "CameraRig":
        """The rig after the ego frame's points were moved by matrices (B, 3, 3), as in `PriorBatch`."""
        moved = torch.eye(4, dtype=augmentations.dtype, device=augmentations.device).repeat(len(augmentations), 1, 1)
        moved[:, :3, :3] = augmentations
        return CameraRig(self.intrinsics, moved[:, None].to(self.ego_from_camera) @ self.ego_from_camera)

    def project(self, points_ego: Tensor, image_size: tuple[int, int]) -> Projection:
        """Where points (..., 3) of the ego frame appear in images of (height, width) pixels."""
        camera_from_ego = torch.linalg.inv(self.ego_from_camera)  # mirrored and scaled ones too
        image_from_ego = self.intrinsics @ camera_from_ego[..., :3, :]  # (B, N, 3, 4)
        flat = points_ego.reshape(-1, 3).to(image_from_ego)
        pixels = torch.einsum("bnij,pj->bnpi", image_from_ego[..., :3], flat) + image_from_ego[..., None, :, 3]
        depth = pixels[..., 2:]
        in_front = depth > LEAST_DEPTH_M
        size = pixels.new_tensor(image_size[::-1])
        places = torch.where(in_front, pixels[..., :2] / depth.clamp(min=LEAST_DEPTH_M) / size, -1.0)
        seen = in_front[..., 0] & ((places >= 0) & (places < 1)).all(-1)
        shape = (*self.intrinsics.shape[:2], *points_ego.shape[:-1])
        return Projection(places.view(*shape, 2), seen.view(shape))
