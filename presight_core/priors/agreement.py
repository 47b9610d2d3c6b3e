"""How far two builds of a tile agree about the ground that both saw."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from presight_core.grid import morton
from presight_core.priors.difference import lattice_voxels, voxel_keys
from presight_core.priors.schema import unpack_columns
from presight_core.priors.tile_table import TileTable

MOST_COSINES = 200_000  # evenly spread voxels; their median is then known to a thousandth
STEPS = np.array(list(product((0, -1, 1), repeat=3)))  # to a voxel itself and the 26 around it


@dataclass(frozen=True)
class Agreement:
    """Figures of a new build against an old one; 1 where there is nothing to compare.

    Only voxels of drives that both builds have are asked for, and only in columns that both observed: a new drive
    may add, and a drive that went may leave a hole.
    """

    coverage: float  # share of the old build's observed columns that the new one observed
    old_found: float  # share of the old voxels with a new one at most one voxel away, along each axis
    new_found: float  # share of the new voxels with an old one likewise
    feature_cosine: float  # between both builds' features of a voxel, centred on their mean; the median


def agreement(old: TileTable, new: TileTable) -> Agreement | None:
    """How far a new build of a tile agrees with the old one; None if no drive is in both."""
    gone = set(old.drives) - set(new.drives)
    if gone == set(old.drives):
        return None
    before, after = _Seen.of(old, new.drives), _Seen.of(new, old.drives)
    return Agreement(
        coverage=_kept_columns(before, new) if gone else _kept_share(old, new),
        old_found=_found_share(before, after),
        new_found=_found_share(after, before),
        feature_cosine=_feature_cosine(before, after),
    )


@dataclass(frozen=True)
class _Seen:
    """A build's voxels: all of them, and which of them drives of the other build saw."""

    table: TileTable
    voxels: NDArray[np.int64]  # (N, 3) on the lattice
    keys: NDArray[np.int64]  # (N,)
    is_shared: NDArray[np.bool_]  # (N,)

    @staticmethod
    def of(table: TileTable, drives: tuple[str, ...]) -> "_Seen":
        voxels = lattice_voxels(table)
        own = set(table.drives) - set(drives)
        is_shared = table.seen_by_others(np.arange(len(voxels)), own)
        return _Seen(table, voxels, voxel_keys(voxels), is_shared)


def _kept_share(old: TileTable, new: TileTable) -> float:
    """Share of the old build's observed columns that the new one observed."""
    _, here, there = np.intersect1d(
        morton(new.block_index), morton(old.block_index), assume_unique=True, return_indices=True
    )
    kept, all_columns = new.observed[here] & old.observed[there], unpack_columns(old.observed).sum()
    return float(unpack_columns(kept).sum() / all_columns) if all_columns else 1.0


def _kept_columns(old: _Seen, new: TileTable) -> float:
    """Likewise, of the columns where drives that are left met something: who looked through a column is not stored."""
    columns = np.unique(old.voxels[old.is_shared, :2], axis=0)
    columns = columns[_observed(old.table, columns)]
    return float(_observed(new, columns).mean()) if len(columns) else 1.0


def _observed(table: TileTable, columns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which lattice columns (N, 2) a build observed."""
    keys, size = morton(table.lattice.block_of(columns)), table.lattice.block_columns
    if not len(table.block_keys):
        return np.zeros(len(columns), np.bool_)
    places = np.searchsorted(table.block_keys, keys).clip(max=len(table.block_keys) - 1)
    x, y = (columns % size).T
    bits = table.observed[places, x, y // 8] >> (y % 8) & 1
    return (table.block_keys[places] == keys) & bits.astype(np.bool_)


def _found_share(asked: _Seen, other: _Seen) -> float:
    """Share of the shared voxels, where both observed, that the other build has within one voxel."""
    voxels = asked.voxels[asked.is_shared]
    missing = voxels[_observed(other.table, voxels[:, :2])]
    count = len(missing)
    known = np.sort(other.keys)
    for step in STEPS:
        if not len(missing):
            break
        missing = missing[~_contains(known, voxel_keys(missing + step))]
    return 1 - len(missing) / count if count else 1.0


def _contains(known: NDArray[np.int64], keys: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which keys are among the known ones, which ascend."""
    if not len(known):
        return np.zeros(len(keys), np.bool_)
    return known[np.searchsorted(known, keys).clip(max=len(known) - 1)] == keys


def _feature_cosine(old: _Seen, new: _Seen) -> float:
    rows_old, rows_new = np.flatnonzero(old.is_shared), np.flatnonzero(new.is_shared)
    _, here, there = np.intersect1d(old.keys[rows_old], new.keys[rows_new], assume_unique=True, return_indices=True)
    if not len(here):
        return 1.0
    chosen = np.linspace(0, len(here) - 1, min(len(here), MOST_COSINES)).astype(np.int64)
    before = _features(old.table, rows_old[here[chosen]])
    after = _features(new.table, rows_new[there[chosen]])
    mean = (before.mean(0) + after.mean(0)) / 2
    before, after = before - mean, after - mean
    lengths = np.linalg.norm(before, axis=-1) * np.linalg.norm(after, axis=-1)
    return float(np.median((before * after).sum(-1) / np.maximum(lengths, 1e-9)))  # equal to the mean: says nothing


def _features(table: TileTable, rows: NDArray[np.int64]) -> NDArray[np.float32]:
    """Features (N, C) of rows in any order."""
    order = np.argsort(rows)
    result = np.empty((len(rows), table.arrays["features"].spec.row_shape[0]), np.float32)
    result[order] = table.rows("features", rows[order])
    return result
