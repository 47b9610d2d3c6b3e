"""Averages surface points in the voxels they fall in, in bounded memory however many points there are.

Points are summed per voxel in memory; when that fills up, the sums go to files in a scratch folder, one
for every superblock (4 x 4 blocks), and are added up file by file at the end.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray

from presight_core.errors import StoreError
from presight_core.grid import Lattice, morton
from presight_core.priors.schema import CENTROID_STEPS, drive_bits, pack_voxels, word_count

SUPERBLOCK = 4  # blocks along an edge, 51 m: what is held at once when sums are merged, 20-120 MB
MEMORY_ROWS = 1 << 19  # voxel sums in memory; a row is 300 bytes at 64 channels, and merging holds three copies
LARGEST_HALF = 65504.0  # float16

_sides = np.arange(SUPERBLOCK)
_cells = np.stack(np.meshgrid(_sides, _sides, indexing="ij"), -1).reshape(-1, 2)
CELLS = _cells[np.argsort(morton(_cells))]  # (16, 2) the blocks of a superblock, in Morton order
RANK = np.argsort(np.argsort(morton(_cells))).reshape(SUPERBLOCK, SUPERBLOCK)  # place of block (x, y) in CELLS

Superblock = tuple[int, int]


@dataclass(frozen=True)
class Samples:
    """Surface points and what the field says there."""

    points_world: NDArray[np.float64]  # (N, 3) metres
    features: NDArray[np.float32]  # (N, C) in [0, 1]
    rgb: NDArray[np.float32]  # (N, 3) in [0, 1]
    density: NDArray[np.float32]  # (N,) per metre

    def select(self, rows: NDArray) -> "Samples":
        """The given rows: a boolean mask or an index array."""
        return replace(self, **{name: values[rows] for name, values in self.__dict__.items()})


@dataclass(frozen=True)
class VoxelMeans:
    """The voxels of one superblock, by block in Morton order, then by packed voxel; types as stored."""

    cell: NDArray[np.int64]  # (N,) index into CELLS of the voxel's block
    voxel: NDArray[np.uint32]  # (N,)
    centroid: NDArray[np.uint8]  # (N, 3)
    features: NDArray[np.uint8]  # (N, C)
    hits: NDArray[np.uint32]  # (N,)
    density: NDArray[np.float16]  # (N,)
    rgb: NDArray[np.uint8]  # (N, 3)
    drives: NDArray[np.uint32]  # (N, words)


class VoxelSums:
    """Sums of surface points per voxel of the city lattice. `add` at will, `finish` once, then read `means`."""

    def __init__(
        self, lattice: Lattice, channel_count: int, drive_count: int, scratch: Path, memory_rows: int = MEMORY_ROWS
    ) -> None:
        self._lattice = lattice
        self._drive_count = drive_count
        self._scratch = scratch
        self._memory_rows = memory_rows
        self._channels = channel_count
        words = ("drives", "<u4", (word_count(drive_count),))
        # Columns of the sums: features, place inside the voxel (3), rgb (3), density.
        self._row = np.dtype([("key", "<i8"), ("hits", "<u4"), words, ("sums", "<f4", (channel_count + 7,))])
        self._numbers: dict[Superblock, int] = {}
        self._runs: list[NDArray] = []

    def add(self, samples: Samples, drive: int) -> None:
        """Add points that were seen by one drive, an index into the tile's drives."""
        if not len(samples.points_world):
            return
        self._runs.append(_add_up(self._rows_of(samples, drive)))
        if sum(map(len, self._runs)) > self._memory_rows:
            merged = _add_up(np.concatenate(self._runs))
            self._runs = [merged]
            if len(merged) > self._memory_rows // 2:  # less would sort the same rows again and again
                self._spill()

    def finish(self, min_hits: int) -> tuple[int, int]:
        """Merge all sums; how many voxels are kept, for having at least `min_hits` points, and how many dropped."""
        if self._runs:
            self._runs = [_add_up(np.concatenate(self._runs))]
            self._spill()
        kept = dropped = 0
        for superblock in self._numbers:
            rows = self._merge(self._file(superblock))
            enough = rows["hits"] >= min_hits
            self._write(self._file(superblock), rows[enough], "wb")
            kept, dropped = kept + int(enough.sum()), dropped + int((~enough).sum())
        return kept, dropped

    @property
    def superblocks(self) -> set[Superblock]:
        """Superblocks that any point fell in."""
        return set(self._numbers)

    def means(self, superblock: Superblock) -> VoxelMeans:
        """The voxels of one superblock, after `finish`."""
        file = self._file(superblock)
        rows = np.fromfile(file, self._row) if file.exists() else np.zeros(0, self._row)
        means = rows["sums"] / rows["hits"][:, None].astype(np.float32)
        features, place, rgb, density = np.split(means, np.cumsum([self._channels, 3, 3]), -1)
        return VoxelMeans(
            cell=rows["key"] >> 32 & 0xF,
            voxel=(rows["key"] & 0xFFFFFFFF).astype(np.uint32),
            centroid=np.clip(place * CENTROID_STEPS, 0, CENTROID_STEPS - 1).astype(np.uint8),
            features=_byte(features),
            hits=rows["hits"].copy(),
            density=np.clip(density[:, 0], 0, LARGEST_HALF).astype(np.float16),
            rgb=_byte(rgb),
            drives=rows["drives"].copy(),
        )

    def _rows_of(self, samples: Samples, drive: int) -> NDArray:
        voxels = self._lattice.voxel_of(samples.points_world)
        place = (samples.points_world - self._lattice.voxel_min(voxels)) / self._lattice.voxel_m
        rows = np.empty(len(voxels), self._row)
        rows["key"] = self._keys(voxels)
        rows["hits"] = 1
        rows["drives"] = drive_bits(drive, self._drive_count)
        rows["sums"] = np.concatenate([samples.features, place, samples.rgb, samples.density[:, None]], -1)
        return rows

    def _keys(self, voxels: NDArray[np.int64]) -> NDArray[np.int64]:
        """Sortable names (N,) of voxels: superblock number (as met), block inside it (4 bits), packed voxel (32)."""
        blocks = self._lattice.block_of(voxels)
        superblocks = blocks // SUPERBLOCK
        _, index, inverse = np.unique(morton(superblocks), return_index=True, return_inverse=True)
        found = [self._numbers.setdefault((x, y), len(self._numbers)) for x, y in superblocks[index].tolist()]
        cells = RANK[tuple((blocks % SUPERBLOCK).T)]
        return np.array(found)[inverse] << 36 | cells << 32 | pack_voxels(voxels, self._lattice)

    def _spill(self) -> None:
        """Move the one sorted run in memory to the files of its superblocks."""
        rows = self._runs.pop()
        names = list(self._numbers)
        numbers, starts = np.unique(rows["key"] >> 36, return_index=True)
        for number, part in zip(numbers, np.split(rows, starts[1:]), strict=True):
            self._write(self._file(names[number]), part, "ab")

    def _merge(self, file: Path) -> NDArray:
        merged = np.zeros(0, self._row)
        for part in self._parts(file):
            merged = _add_up(np.concatenate([merged, part]))
        return merged

    def _parts(self, file: Path) -> Iterator[NDArray]:
        rows = file.stat().st_size // self._row.itemsize
        for first in range(0, rows, self._memory_rows):
            yield np.fromfile(file, self._row, self._memory_rows, offset=first * self._row.itemsize)

    def _write(self, file: Path, rows: NDArray, mode: str) -> None:
        try:
            with file.open(mode) as stream:
                rows.tofile(stream)
        except OSError as error:
            raise StoreError(f"{file}: {error}; free space for scratch files and run again") from error

    def _file(self, superblock: Superblock) -> Path:
        return self._scratch / f"{superblock[0]}_{superblock[1]}.sums"


def _add_up(rows: NDArray) -> NDArray:
    """One row a key, ascending, that sums the rows of that key."""
    order = np.argsort(rows["key"], kind="stable")
    keys = rows["key"][order]
    is_first = np.concatenate([[True], keys[1:] != keys[:-1]])
    result = np.zeros(int(is_first.sum()), rows.dtype)
    result["key"] = keys[is_first]
    slots = np.cumsum(is_first) - 1
    _add_rows(rows, order, slots, result)
    return result


@numba.njit(cache=True)
def _add_rows(rows: NDArray, order: NDArray, slots: NDArray, result: NDArray) -> None:
    """Plain loops: numpy's reduceat over rows of a matrix is many times slower."""
    for place in range(len(order)):
        row, total = rows[order[place]], result[slots[place]]
        total["hits"] += row["hits"]
        for word in range(len(row["drives"])):
            total["drives"][word] |= row["drives"][word]
        for column in range(len(row["sums"])):
            total["sums"][column] += row["sums"][column]


def _byte(unit: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Values in [0, 1] as 0..255."""
    return np.round(np.clip(unit, 0, 1) * 255).astype(np.uint8)
