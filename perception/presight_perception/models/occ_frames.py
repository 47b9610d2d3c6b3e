"""What goes into and comes out of an occupancy model: earlier frames, truth, predictions.

Voxels are (B, C, Z, Y, X), logits and classes in Occ3D's order, (B, X, Y, Z).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from presight_core.classes import UNKNOWN
from presight_core.errors import InputError
from presight_perception.models.camera_rig import CameraRig
from presight_perception.models.lift_splat import DepthBins, depth_bins, moved
from presight_perception.models.occ_losses import depth_loss
from presight_perception.occupancy_truth import OCCUPANCY_CLASSES, RANGE_LOW_M, VOXEL_M, OccupancyTruth
from presight_perception.voxelise import VoxelGrid

CLASS_COUNT = len(OCCUPANCY_CLASSES)

NUSCENES_VOXELS = (
    944004, 1897170, 152386, 2391677, 16957802, 724139, 189027, 2074468, 413451, 2384460, 5916653, 175883646,
    4275424, 51393615, 61411620, 105975596, 116424404, 1892500630,
)  # fmt: skip  # of each class in Occ3D-nuScenes' training split: rare classes count more


@dataclass(frozen=True)
class PastFrame:
    """An earlier moment of the same drives: its images and rig, or what the model remembered of them."""

    past_from_now: Tensor  # (B, 4, 4) takes points of the present ego frame to the earlier one
    age_s: Tensor  # (B,) seconds before now
    images: Tensor | None = None  # (B, N, 3, H, W)
    rig: CameraRig | None = None  # in the earlier ego frame
    voxels: Tensor | None = None  # `OccupancyPredictions.voxels` of that moment, which spares its images

    def seen(self) -> tuple[Tensor, CameraRig]:
        """Its images and rig. Raises InputError if one is absent."""
        if self.images is None or self.rig is None:
            raise InputError("an earlier frame has neither voxels nor images with a rig; give one of them")
        return self.images, self.rig


@dataclass(frozen=True)
class OccupancyPredictions:
    """What an occupancy model found."""

    logits: Tensor  # (B, X, Y, Z, 18)
    depth: Tensor | None  # (B, N, D, h, w) probability of each depth bin; None without cameras
    voxels: Tensor | None  # (B, C, Z, Y, X) of this frame alone, detached: for the `PastFrame` of later ones


@dataclass(frozen=True)
class OccupancyTarget:
    """What one sample's prediction is compared with in training."""

    classes: Tensor  # (X, Y, Z) uint8; 255 is unknown or seen by no camera
    depth_m: Tensor | None = None  # (N, H, W) along the camera's axis where a lidar point fell on the pixel; else 0

    @classmethod
    def of(cls, truth: OccupancyTruth, depth_m: Tensor | None = None) -> "OccupancyTarget":
        """The voxels that a camera saw, as in the originals."""
        return cls(torch.from_numpy(np.where(truth.mask_camera, truth.semantics, np.uint8(UNKNOWN))), depth_m)


def within(truth: OccupancyTruth, grid: VoxelGrid) -> OccupancyTruth:
    """The part of Occ3D's truth that lies in a grid's box. Raises InputError if the box reaches beyond it."""
    first = [round((edge - low) / VOXEL_M) for edge, low in zip(grid.low_m, RANGE_LOW_M, strict=True)]
    last = [round((edge - low) / VOXEL_M) for edge, low in zip(grid.high_m, RANGE_LOW_M, strict=True)]
    if min(first) < 0 or any(end > count for end, count in zip(last, truth.semantics.shape, strict=True)):
        raise InputError(
            f"truth of {truth.semantics.shape} voxels does not cover {grid.low_m} to {grid.high_m} m; "
            "give all of Occ3D's range, or a smaller grid"
        )
    box = tuple(slice(start, end) for start, end in zip(first, last, strict=True))
    return OccupancyTruth(truth.semantics[box], truth.mask_camera[box], truth.mask_lidar[box])


def known_voxels(logits: Tensor, truths: Sequence[OccupancyTarget]) -> tuple[Tensor, Tensor]:
    """Which voxels (B, X, Y, Z) have a known class, and those classes (V,).

    Raises InputError for truth on another grid than that of the logits (B, X, Y, Z, 18).
    """
    classes = torch.stack([truth.classes for truth in truths]).to(logits.device)
    if classes.shape != logits.shape[:4]:
        raise InputError(
            f"predicted voxels {tuple(logits.shape[:4])}, true ones {tuple(classes.shape)}; "
            "give truth on the grid that the model's settings predict"
        )
    known = classes < CLASS_COUNT
    return known, classes[known].long()


def lidar_loss(depth: Tensor | None, truths: Sequence[OccupancyTarget], bins: DepthBins) -> Tensor | None:
    """The loss of predicted depth (B, N, D, h, w); None without cameras, or if a sample has no lidar depths."""
    known = [truth.depth_m for truth in truths if truth.depth_m is not None]
    if depth is None or len(known) < len(truths):
        return None
    return depth_loss(depth, depth_bins(torch.stack(known).to(depth), (depth.shape[-2], depth.shape[-1]), bins))


def centres(grid: VoxelGrid, like: Tensor) -> Tensor:
    """Centres (Z, Y, X, 3) of a grid's voxels, as x, y, z in metres."""
    axes = [
        low + (torch.arange(count, device=like.device, dtype=like.dtype) + 0.5) * size
        for low, size, count in zip(grid.low_m, grid.voxel_m, grid.shape, strict=True)
    ]
    z, y, x = torch.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    return torch.stack([x, y, z], -1)


def aligned(voxels: Tensor, past_from_now: Tensor, grid: VoxelGrid) -> Tensor:
    """An earlier moment's voxels as they lie around the vehicle now; zeros where the earlier grid did not reach."""
    points_now = centres(grid, voxels).expand(len(voxels), -1, -1, -1, -1)
    points_past = moved(points_now, past_from_now.to(voxels))
    low, high = points_past.new_tensor(grid.low_m), points_past.new_tensor(grid.high_m)
    shares = 2 * (points_past - low) / (high - low) - 1  # -1..1 over the box, x first, as grid_sample wants it
    return functional.grid_sample(voxels, shares, align_corners=False)
