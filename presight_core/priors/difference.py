"""What changed between two builds of a tile, voxel by voxel."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from presight_core.priors.schema import unpack_voxels
from presight_core.priors.tile_table import TileTable

COMPARED = ("centroid", "features", "hits", "density", "rgb")
OFFSET = 1 << 20  # columns: makes indices of +-400 km at 0.4 m positive
COLUMN_BITS = 21  # of a key, for each of x and y
HEIGHT_BITS = 17  # heights have 16


@dataclass(frozen=True)
class TileDifference:
    """Lattice voxels (N, 3) of a tile: which build has them, and whether both hold the same of them."""

    added: NDArray[np.int64]
    removed: NDArray[np.int64]
    changed: NDArray[np.int64]
    same: NDArray[np.int64]


def tile_difference(old: TileTable | None, new: TileTable | None) -> TileDifference:
    """What changed from one build of a tile to another; None for a tile that is not there."""
    before, after = lattice_voxels(old), lattice_voxels(new)
    keys_before, keys_after = voxel_keys(before), voxel_keys(after)
    _, there, here = np.intersect1d(keys_before, keys_after, assume_unique=True, return_indices=True)
    differs = np.zeros(len(there), np.bool_)
    if old is not None and new is not None:
        for name in COMPARED:
            unequal = old.all_rows(name)[there] != new.all_rows(name)[here]
            differs |= unequal.any(tuple(range(1, unequal.ndim)))
    return TileDifference(
        added=np.delete(after, here, axis=0),
        removed=np.delete(before, there, axis=0),
        changed=after[here[differs]],
        same=after[here[~differs]],
    )


def lattice_voxels(table: TileTable | None) -> NDArray[np.int64]:
    """The lattice voxels (N, 3) of a build, in the order of its rows; none for None."""
    if table is None:
        return np.zeros((0, 3), np.int64)
    blocks = np.repeat(table.block_index, np.diff(table.block_start), axis=0)
    return unpack_voxels(table.all_rows("voxel"), blocks, table.lattice)


def voxel_keys(voxels: NDArray[np.int64]) -> NDArray[np.int64]:
    """One number for each lattice voxel (N, 3)."""
    x, y, z = (voxels + np.array([OFFSET, OFFSET, 1 << (HEIGHT_BITS - 1)])).T
    return (x << COLUMN_BITS | y) << HEIGHT_BITS | z
