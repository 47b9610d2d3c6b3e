"""Pinhole cameras: where a world point falls in the image, and which ray a pixel sees.

Image coordinates are pixels, x right and y down; the first pixel's centre is (0.5, 0.5).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from presight_core import frames

NEAR_M = 1e-6  # points closer to the image plane than this have no projection


@dataclass(frozen=True)
class Camera:
    """One image's camera: intrinsics (3, 3) in pixels, `world_from_camera` (4, 4) in metres, image size."""

    intrinsics: NDArray[np.float64]
    world_from_camera: NDArray[np.float64]
    width_px: int
    height_px: int

    def project(self, points_world: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pixels (N, 2) and depths along the optical axis (N,), metres, of world points (N, 3).

        Points at or behind the image plane get NaN pixels; use `sees` for the image bounds.
        """
        points_camera = frames.apply(frames.invert(self.world_from_camera), points_world)
        depth_m = points_camera[:, 2]
        in_front = np.where(depth_m > NEAR_M, depth_m, np.nan)
        pixels = (points_camera @ self.intrinsics.T)[:, :2] / in_front[:, None]
        return pixels, depth_m

    def sees(self, points_world: ArrayLike) -> NDArray[np.bool_]:
        """Which world points (N, 3) fall inside the image, occlusion left aside."""
        pixels, _ = self.project(points_world)
        return np.all((pixels >= 0) & (pixels < [self.width_px, self.height_px]), axis=-1)

    def rays(self, pixels: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Origin (3,) and unit directions (N, 3), both world, of the rays through pixels (N, 2)."""
        return self.world_from_camera[:3, 3], ray_directions(pixels, self.intrinsics, self.world_from_camera)

    def scaled(self, width_px: int, height_px: int) -> "Camera":
        """The same camera with the image resized to the given size."""
        factors = np.array([width_px / self.width_px, height_px / self.height_px, 1.0])
        return Camera(self.intrinsics * factors[:, None], self.world_from_camera, width_px, height_px)


def ray_directions(
    pixels: ArrayLike, intrinsics: NDArray[np.float64], world_from_camera: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Unit world directions (N, 3) through pixels (N, 2).

    One camera for all ((3, 3) and (4, 4)), or a camera per pixel ((N, 3, 3) and (N, 4, 4)).
    """
    pixels = np.asarray(pixels, np.float64)
    homogeneous = np.concatenate([pixels, np.ones_like(pixels[:, :1])], -1)
    camera = np.einsum("...ij,...j->...i", np.linalg.inv(intrinsics), homogeneous)
    world = np.einsum("...ij,...j->...i", world_from_camera[..., :3, :3], camera)
    return world / np.linalg.norm(world, axis=-1, keepdims=True)


def pixel_centres(width_px: int, height_px: int, stride: int = 1) -> NDArray[np.float64]:
    """Centres (rows * columns, 2) of every `stride`-th pixel, row by row, taken from the middle of each stride."""
    x = np.arange(stride // 2, width_px, stride) + 0.5
    y = np.arange(stride // 2, height_px, stride) + 0.5
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2).astype(np.float64)
