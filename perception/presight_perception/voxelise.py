"""Voxels from the points of a prior: 68 channels, equal to the paper's released voxeliser, in numpy and in torch.

Channels: mean position scaled to 0..1 over the grid (3), mean features (64), log of the summed hits (1).
Means are weighted by hits. The released limits are left out: of 16 points a voxel, a random choice that the
centroids of a 0.4 m lattice hardly ever meet, and of 100,000 voxels, several times what a street fills.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor


@dataclass(frozen=True)
class VoxelGrid:
    """A box of the ego frame, cut into voxels."""

    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]
    voxel_m: tuple[float, float, float]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels along x, y and z."""
        x, y, z = (
            round((high - low) / size) for low, high, size in zip(self.low_m, self.high_m, self.voxel_m, strict=True)
        )
        return x, y, z


MAPPING_GRID = VoxelGrid((-50.0, -25.0, -3.0), (50.0, 25.0, 5.0), (0.5, 0.5, 0.5))  # as released
OCCUPANCY_GRID = VoxelGrid((-40.0, -40.0, -2.0), (40.0, 40.0, 6.0), (0.4, 0.4, 0.4))  # as released


@dataclass(frozen=True)
class BevAugmentation:
    """A turn about z, then a scale, then mirrors, of everything in the ego frame."""

    rotation_rad: float = 0.0  # counter-clockwise seen from above
    scale: float = 1.0
    flip_x: bool = False  # front becomes back
    flip_y: bool = False  # left becomes right

    @property
    def matrix(self) -> NDArray[np.float64]:
        """What takes points (N, 3) to their new places: `points @ matrix.T`."""
        cosine, sine = np.cos(self.rotation_rad), np.sin(self.rotation_rad)
        turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        mirror = np.array([-1.0 if self.flip_x else 1.0, -1.0 if self.flip_y else 1.0, 1.0])
        return mirror[:, None] * self.scale * turn


class Voxels(NamedTuple):
    """The occupied voxels of a grid, ordered by x, then y, then z."""

    features: NDArray[np.float32]  # (V, 4 + C)
    coordinates: NDArray[np.int32]  # (V, 3) x, y, z


class VoxelTensors(NamedTuple):
    """The same on a device."""

    features: Tensor  # (V, 4 + C) float32
    coordinates: Tensor  # (V, 3) int64 x, y, z


def voxelise(points_ego: ArrayLike, features: NDArray | None, hits: ArrayLike, grid: VoxelGrid) -> Voxels:
    """Voxels of points (N, 3) with features (N, C), or None for geometry alone, and hits (N,) above 0.

    Features are shares, 0..1, or the store's bytes, 0..255.
    """
    points, weights = np.asarray(points_ego, np.float64).reshape(-1, 3), np.asarray(hits, np.float64).reshape(-1)
    low, high = np.array(grid.low_m), np.array(grid.high_m)
    cells = np.floor((points - low) / grid.voxel_m).astype(np.int64)
    inside = np.flatnonzero(np.all((cells >= 0) & (cells < grid.shape), -1))
    _, y_count, z_count = grid.shape
    numbers = cells[inside] @ np.array([y_count * z_count, z_count, 1])
    order = np.argsort(numbers, kind="stable")  # a voxel's points next to each other
    rows, numbers = inside[order], numbers[order]
    starts = np.flatnonzero(np.diff(numbers, prepend=-1))
    summed = _sums(weights[rows], starts)
    share = weights[rows] / np.repeat(summed, np.diff(starts, append=len(rows)))  # of each point in its voxel
    channels = np.empty((len(starts), 4 + (0 if features is None else features.shape[1])), np.float32)
    channels[:, :3] = _sums((points[rows] - low) / (high - low) * share[:, None], starts)
    if features is not None:  # most of the work: in float32, a voxel having few points
        scale = 1 / 255 if features.dtype == np.uint8 else 1.0
        channels[:, 3:-1] = _sums(features[rows] * (share * scale).astype(np.float32)[:, None], starts)
    channels[:, -1] = np.log(summed)
    return Voxels(channels, np.stack(np.unravel_index(numbers[starts], grid.shape), -1).astype(np.int32))


def voxelise_tensors(points_ego: Tensor, features: Tensor | None, hits: Tensor, grid: VoxelGrid) -> VoxelTensors:
    """The same as `voxelise`, on the tensors' device."""
    points, weights = points_ego.double(), hits.double().reshape(-1)
    low, high, size = (points.new_tensor(values) for values in (grid.low_m, grid.high_m, grid.voxel_m))
    _, y_count, z_count = grid.shape
    cells = ((points - low) / size).floor().long()
    inside = ((cells >= 0) & (cells < cells.new_tensor(grid.shape))).all(-1)
    cells, weights = cells[inside], weights[inside]
    numbers = (cells[:, 0] * y_count + cells[:, 1]) * z_count + cells[:, 2]
    numbers, voxel_of_point = numbers.unique(return_inverse=True)
    summed = weights.new_zeros(len(numbers)).index_add_(0, voxel_of_point, weights)
    share = (weights / summed[voxel_of_point]).unsqueeze(-1)
    columns = [((points - low) / (high - low))[inside] * share]
    if features is not None:
        scale = 1 / 255 if features.dtype == torch.uint8 else 1.0
        columns.append(features[inside] * (share * scale).float())
    means = [
        column.new_zeros(len(numbers), column.shape[1]).index_add_(0, voxel_of_point, column) for column in columns
    ]
    coordinates = torch.stack([numbers // (y_count * z_count), numbers // z_count % y_count, numbers % z_count], -1)
    return VoxelTensors(torch.cat([mean.float() for mean in means] + [summed.log().float()[:, None]], -1), coordinates)


def inside_range(points_ego: ArrayLike, grid: VoxelGrid) -> NDArray[np.bool_]:
    """Which points (N, 3) lie in the grid's box, both faces included.

    The released code drops the others *before* it augments, so that turned corners come out empty. Here it is
    for comparison only: a window with a margin keeps the corners.
    """
    points = np.asarray(points_ego, np.float64)
    return np.all((points >= grid.low_m) & (points <= grid.high_m), -1)


@dataclass(frozen=True)
class VoxelDrop:
    """What training hides of a prior, lest the model lean on it alone."""

    greatest_share: float = 1.0  # of single voxels: each sample loses a random share up to this (paper: 1)
    whole_chance: float = 0.0  # of losing the whole prior; 0.3 to 0.5 keeps a model from ignoring its cameras
    side_chance: float = 0.0  # of losing a random share of the voxels, all on one side of a line, as new ground does

    def apply(self, voxels: Voxels, random: np.random.Generator) -> Voxels:
        """The voxels that remain, in order. Draws the same numbers from `random` whatever the voxels."""
        whole, share, side, side_share, angle = random.random(5)
        kept = random.random(len(voxels.features)) >= share * self.greatest_share
        if whole < self.whole_chance:
            kept[:] = False
        elif side < self.side_chance and len(kept):
            across = voxels.coordinates[:, :2] @ np.array([np.cos(2 * np.pi * angle), np.sin(2 * np.pi * angle)])
            kept &= across >= np.quantile(across, side_share)
        return Voxels(voxels.features[kept], voxels.coordinates[kept])


def _sums(values: NDArray, starts: NDArray[np.int64]) -> NDArray:
    """Sums (V, ...) of consecutive rows, each group beginning at one of `starts`. For groups of few rows."""
    counts = np.diff(starts, append=len(values))
    sums = values[starts]
    for rank in range(1, counts.max(initial=0)):
        longer = np.flatnonzero(counts > rank)
        sums[longer] += values[starts[longer] + rank]
    return sums
