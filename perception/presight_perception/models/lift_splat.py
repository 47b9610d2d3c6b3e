"""Lift, splat: image features spread along their rays by predicted depth, summed in voxels (Philion and Fidler, 2020).

With BEVDepth's camera-aware depth net, as in BEVDet-Occ and FB-OCC.
"""

from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from presight_core.errors import InputError
from presight_perception.bev_pooling import PoolingGrid, bev_pool
from presight_perception.models.backbone import Basic
from presight_perception.models.camera_rig import CameraRig
from presight_perception.voxelise import VoxelGrid

Size = tuple[int, int]  # height, width

CAMERA_NUMBERS = 18  # two rows of the intrinsics, three of the camera's pose
DILATIONS = (6, 12, 18)  # of the depth net's context, in feature pixels: as released
ASPP_DROPOUT = 0.5  # as released


@dataclass(frozen=True)
class DepthBins:
    """Depths along the camera's axis, cut evenly."""

    low_m: float = 1.0
    high_m: float = 45.0
    step_m: float = 0.5

    @property
    def count(self) -> int:
        return round((self.high_m - self.low_m) / self.step_m)

    def centres(self, like: Tensor) -> Tensor:
        """The middle (D,) of each bin, metres."""
        return self.low_m + (torch.arange(self.count, device=like.device, dtype=like.dtype) + 0.5) * self.step_m

    def numbers(self, depth_m: Tensor) -> Tensor:
        """The bin of each depth, int64; -1 outside."""
        number = ((depth_m - self.low_m) / self.step_m).floor().long()
        return number.masked_fill((number < 0) | (number >= self.count), -1)


@dataclass(frozen=True)
class LiftSettings:
    """Sizes of the depth net; the defaults are BEVDet-Occ's."""

    inputs: int = 256  # channels of the image features
    width: int = 256
    context: int = 32  # channels of the voxels
    bins: DepthBins = field(default_factory=DepthBins)
    aspp_width: int = 96
    camera_aware: bool = True  # False: one convolution of one pixel, as in the first BEVDet


class LiftSplat(nn.Module):
    """Voxels from the image features of several cameras."""

    def __init__(self, settings: LiftSettings, grid: VoxelGrid) -> None:
        super().__init__()
        self.settings, self.grid = settings, grid
        self.net = DepthNet(settings) if settings.camera_aware else PlainDepthNet(settings)

    def forward(
        self, features: Tensor, rig: CameraRig, image_size: Size, now_from_past: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Voxels (B, context, Z, Y, X) of features (B, N, inputs, h, w), and the net's context and depth.

        image_size: (height, width) in pixels. now_from_past (B, 4, 4) takes an earlier frame's points to where they are
        around the vehicle now.
        """
        context, depth = self.net(features, rig)
        points_ego = frustum(rig, image_size, (features.shape[-2], features.shape[-1]), self.settings.bins)
        if now_from_past is not None:
            points_ego = moved(points_ego, now_from_past)
        grid = PoolingGrid(self.grid.low_m, self.grid.voxel_m, self.grid.shape)
        return bev_pool(points_ego, depth, context, grid), context, depth


class PlainDepthNet(nn.Module):
    """Depth and context from one convolution."""

    def __init__(self, settings: LiftSettings) -> None:
        super().__init__()
        self.bin_count = settings.bins.count
        self.convolution = nn.Conv2d(settings.inputs, settings.bins.count + settings.context, 1)

    def forward(self, features: Tensor, rig: CameraRig) -> tuple[Tensor, Tensor]:
        """Context (B, N, context, h, w) and depth (B, N, D, h, w), which sums to 1 over the bins."""
        found = self.convolution(features.flatten(0, 1)).unflatten(0, features.shape[:2])
        return found[:, :, self.bin_count :], found[:, :, : self.bin_count].softmax(2)


class DepthNet(nn.Module):
    """Depth and context that know the camera: its intrinsics and pose open and close channels (BEVDepth, 3.3)."""

    def __init__(self, settings: LiftSettings) -> None:
        super().__init__()
        width = settings.width
        self.reduce = nn.Sequential(nn.Conv2d(settings.inputs, width, 3, padding=1), nn.BatchNorm2d(width), nn.ReLU())
        self.camera_norm = nn.BatchNorm1d(CAMERA_NUMBERS)
        self.context_gate, self.depth_gate = CameraGate(width), CameraGate(width)
        self.context = nn.Conv2d(width, settings.context, 1)
        blocks = [Basic(width, width, 1) for _ in range(3)]  # three: as released
        self.depth = nn.Sequential(
            *blocks, DilatedContext(width, settings.aspp_width), nn.Conv2d(width, settings.bins.count, 1)
        )

    def forward(self, features: Tensor, rig: CameraRig) -> tuple[Tensor, Tensor]:
        """Context (B, N, context, h, w) and depth (B, N, D, h, w), which sums to 1 over the bins."""
        camera = self.camera_norm(camera_numbers(rig).flatten(0, 1))
        reduced = self.reduce(features.flatten(0, 1))
        context = self.context(self.context_gate(reduced, camera))
        depth = self.depth(self.depth_gate(reduced, camera)).softmax(1)
        return context.unflatten(0, features.shape[:2]), depth.unflatten(0, features.shape[:2])


class CameraGate(nn.Module):
    """Scales channels by what a camera's numbers say."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.embed = nn.Sequential(nn.Linear(CAMERA_NUMBERS, width), nn.ReLU(), nn.Linear(width, width))
        self.gate = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width), nn.Sigmoid())

    def forward(self, features: Tensor, camera: Tensor) -> Tensor:
        return features * self.gate(self.embed(camera))[:, :, None, None]


class DilatedContext(nn.Module):
    """Atrous spatial pyramid pooling (DeepLab v3): four reaches and the whole image, mixed."""

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        reaches = [_convolution_2d(channels, width, 1)]
        reaches += [_convolution_2d(channels, width, 3, dilation) for dilation in DILATIONS]
        self.reaches = nn.ModuleList(reaches)
        self.whole = _convolution_2d(channels, width, 1)
        self.mix = _convolution_2d(width * (len(reaches) + 1), channels, 1)
        self.dropout = nn.Dropout(ASPP_DROPOUT)

    def forward(self, features: Tensor) -> Tensor:
        found = [reach(features) for reach in self.reaches]
        whole = self.whole(features.mean((2, 3), keepdim=True)).expand_as(found[0])
        return self.dropout(self.mix(torch.cat([*found, whole], 1)))


def frustum(rig: CameraRig, image_size: Size, size: Size, bins: DepthBins) -> Tensor:
    """Points (B, N, D, h, w, 3) of the ego frame in metres: of each feature pixel's centre, each bin's middle.

    image_size and size: (height, width) of the images and of their features.
    """
    like = rig.ego_from_camera
    rows, columns = (
        (torch.arange(count, device=like.device, dtype=like.dtype) + 0.5) * (pixels / count)
        for count, pixels in zip(size, image_size, strict=True)
    )
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    rays = torch.einsum("bnij,hwj->bnhwi", rig.intrinsics.inverse(), torch.stack([u, v, torch.ones_like(u)], -1))
    points_camera = rays.unsqueeze(2) * bins.centres(like)[:, None, None, None]
    return moved(points_camera, like)


def moved(points_b: Tensor, a_from_b: Tensor) -> Tensor:
    """Points (batch, ..., 3) taken to another frame by transforms (batch, 4, 4), whatever the batch dimensions."""
    flat = points_b.flatten(a_from_b.ndim - 2, -2)
    found = flat @ a_from_b[..., :3, :3].mT + a_from_b[..., None, :3, 3]
    return found.view(points_b.shape)


def camera_numbers(rig: CameraRig) -> Tensor:
    """What the depth net is told of each camera (B, N, 18): augmentations of image and ego frame are part of it."""
    return torch.cat([rig.intrinsics[:, :, :2].flatten(2), rig.ego_from_camera[:, :, :3].flatten(2)], -1)


def depth_bins(depth_m: Tensor, size: Size, bins: DepthBins) -> Tensor:
    """The bin (B, N, h, w) of the nearest known depth in each feature pixel, -1 without any.

    depth_m (B, N, H, W), 0 where unknown. Raises InputError if features of `size` do not tile the image.
    """
    height, width = size
    rows, columns = depth_m.shape[-2] // height, depth_m.shape[-1] // width
    if depth_m.shape[-2:] != (rows * height, columns * width):
        raise InputError(f"depths {tuple(depth_m.shape[-2:])} do not tile into {size} features; give the images' size")
    far = depth_m.masked_fill(depth_m <= 0, float("inf"))
    blocks = far.unflatten(3, (width, columns)).unflatten(2, (height, rows))
    nearest = blocks.amin((3, 5))
    return bins.numbers(nearest.nan_to_num(posinf=0.0)).masked_fill(nearest.isinf(), -1)


def _convolution_2d(inputs: int, outputs: int, size: int, dilation: int = 1) -> nn.Sequential:
    padding = dilation * (size // 2)
    convolution = nn.Conv2d(inputs, outputs, size, padding=padding, dilation=dilation, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs), nn.ReLU())
