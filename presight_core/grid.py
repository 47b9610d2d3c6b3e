"""The city lattice: one grid of voxels a city, cut into blocks of 32 x 32 columns.

The lattice is anchored at the world origin, so that every tile and every rebuild of a city meets the
same voxels, and nothing ever has to be merged or shifted.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

MORTON_OFFSET = 1 << 31  # shifts signed block indices to unsigned, so that order holds across zero


@dataclass(frozen=True)
class Lattice:
    """Voxels of `voxel_m` metres from `origin_m` (world), in blocks of `block_columns` x `block_columns` columns."""

    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    voxel_m: float = 0.4  # the paper's voxel size
    block_columns: int = 32

    @property
    def block_m(self) -> float:
        """Edge of a block, metres."""
        return self.voxel_m * self.block_columns

    def voxel_of(self, points_world: ArrayLike) -> NDArray[np.int64]:
        """Voxel indices (N, 3) that hold world points (N, 3)."""
        return np.floor((np.asarray(points_world, np.float64) - self.origin_m) / self.voxel_m).astype(np.int64)

    def voxel_min(self, voxels: ArrayLike) -> NDArray[np.float64]:
        """Lower corners (N, 3), world metres, of voxels (N, 3)."""
        return np.asarray(voxels, np.float64) * self.voxel_m + self.origin_m

    def block_of(self, voxels: ArrayLike) -> NDArray[np.int32]:
        """Block indices (N, 2) of voxels or columns (N, 2 or 3)."""
        return np.floor_divide(np.asarray(voxels)[..., :2], self.block_columns).astype(np.int32)

    def block_centre(self, blocks: ArrayLike) -> NDArray[np.float64]:
        """Centres (N, 2), world metres, of blocks (N, 2)."""
        return (np.asarray(blocks, np.float64) + 0.5) * self.block_m + self.origin_m[:2]


def morton(blocks: ArrayLike) -> NDArray[np.uint64]:
    """Morton (Z-order) keys (N,) of block indices (N, 2): blocks near in the city are near on disk."""
    shifted = (np.asarray(blocks, np.int64) + MORTON_OFFSET).astype(np.uint64)
    return _spread(shifted[..., 0]) | (_spread(shifted[..., 1]) << np.uint64(1))


def _spread(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """The 32 low bits of each value, moved to the even bits."""
    for shift, mask in (
        (16, 0x0000FFFF0000FFFF),
        (8, 0x00FF00FF00FF00FF),
        (4, 0x0F0F0F0F0F0F0F0F),
        (2, 0x3333333333333333),
        (1, 0x5555555555555555),
    ):
        values = (values | (values << np.uint64(shift))) & np.uint64(mask)
    return values
