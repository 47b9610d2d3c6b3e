"""The lidar points of past drives as a prior, to compare with: the paper's other prior type (Table 3).

Points of all sweeps are taken as they are, moving things included, as the paper has them. They have no features:
a voxel's four channels are its mean position and its hits.
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from presight_core import frames
from presight_core.errors import InputError
from presight_core.grid import Lattice
from presight_core.priors.window import WindowBox
from presight_core.progress import Progress, Report, silent
from presight_perception.dataset import Place, PriorPoints, Range
from presight_perception.lidar_sweeps import Sweep, read_sweeps

# x, y and z of what is the own vehicle, which the lidar sees: a car of 4.1 x 1.7 x 1.6 m around its rear axle's middle.
VEHICLE_M = ((-1.0, 3.7), (-1.0, 1.0), (-0.5, 2.0))


@dataclass(frozen=True)
class CityHistory:
    """A city's lidar points: of each lattice voxel and each drive that hit it one, ordered by block.

    The voxeliser adds up the drives. Leaving one out thus leaves what the others saw, as if it had never been there.
    """

    lattice: Lattice
    drives: tuple[str, ...]
    block_index: NDArray[np.int32]  # (B, 2)
    block_start: NDArray[np.int64]  # (B + 1,)
    points_world: NDArray[np.float32]  # (N, 3) mean of the hits, metres; within 0.3 mm up to 4 km from the origin
    hits: NDArray[np.uint32]  # (N,)
    drive: NDArray[np.uint16]  # (N,) row of `drives`
    voxel_count: int  # of all drives together

    def __len__(self) -> int:
        return len(self.hits)

    @property
    def size_bytes(self) -> int:
        """Memory of the columns."""
        columns = (self.block_index, self.block_start, self.points_world, self.hits, self.drive)
        return sum(column.nbytes for column in columns)

    def window(self, box: WindowBox, without_drives: Collection[str] = ()) -> PriorPoints:
        """The points in a box that other drives hit; weights are hits over the mean hits of the city's voxels."""
        blocks = np.flatnonzero(box.meets(self.block_index, self.lattice))
        spans = [np.arange(self.block_start[block], self.block_start[block + 1]) for block in blocks]
        rows = np.concatenate([np.zeros(0, np.int64), *spans])
        points_ego, inside = box.inside(self.points_world[rows].astype(np.float64))
        left_out = [number for number, drive in enumerate(self.drives) if drive in without_drives]
        inside &= ~np.isin(self.drive[rows], left_out)
        mean_hits = self.hits.sum(dtype=np.int64) / self.voxel_count
        weights = (self.hits[rows[inside]] / mean_hits).astype(np.float32)
        return PriorPoints(points_ego[inside].astype(np.float32), np.zeros((len(weights), 0), np.uint8), weights)


class LidarHistory:
    """Lidar points of past drives, for `PriorDataset`. Can be pickled; forked workers share its memory."""

    def __init__(self, cities: dict[str, CityHistory]) -> None:
        self.cities = cities

    @staticmethod
    def from_tables(
        root: Path, version: str, drives: Collection[str], lattice: Lattice | None = None, report: Report = silent
    ) -> "LidarHistory":
        """The history that drives (scene names) leave, from the LIDAR_TOP keyframes of tables in `root / version`.

        Raises InputError for tables or sweeps that are missing or damaged, and for drives without sweeps.
        """
        lattice = lattice or Lattice()
        sweeps = sorted(read_sweeps(root, version, drives), key=lambda sweep: (sweep.city, sweep.drive))
        parts: dict[str, dict[str, _Voxels]] = {}
        done = 0
        for (city, drive), group in groupby(sweeps, lambda sweep: (sweep.city, sweep.drive)):
            of_drive = list(group)
            parts.setdefault(city, {})[drive] = _voxels(of_drive, lattice)
            done += len(of_drive)
            report(Progress("lidar history", done, len(sweeps)))
        return LidarHistory({city: _city(of_city, lattice) for city, of_city in parts.items()})

    @property
    def channel_count(self) -> int:
        """None: lidar points are geometry alone."""
        return 0

    def points(self, place: Place, ranges: tuple[Range, Range, Range]) -> PriorPoints:
        """The points in a box around a place. Raises InputError for a city that no drive was in."""
        if place.city is None:
            return PriorPoints.none(self.channel_count)
        if place.city not in self.cities:
            raise InputError(f"no drive was in {place.city!r}, only in {sorted(self.cities)}; make it from more drives")
        return self.cities[place.city].window(WindowBox.at(place.world_from_ego, *ranges), place.without_drives)


@dataclass(frozen=True)
class _Voxels:
    """What one drive hit."""

    voxels: NDArray[np.int32]  # (V, 3) on the lattice
    points_world: NDArray[np.float32]  # (V, 3)
    hits: NDArray[np.uint32]  # (V,)


def _voxels(sweeps: Iterable[Sweep], lattice: Lattice) -> _Voxels:
    points_world = np.concatenate([_points_world(sweep) for sweep in sweeps])
    voxels = lattice.voxel_of(points_world)
    _, first, voxel_of_point, hits = np.unique(
        _keys(voxels), return_index=True, return_inverse=True, return_counts=True
    )
    sums = [np.bincount(voxel_of_point, axis) for axis in points_world.T]
    means = np.stack(sums, -1) / hits[:, None]
    return _Voxels(voxels[first].astype(np.int32), means.astype(np.float32), hits.astype(np.uint32))


def _points_world(sweep: Sweep) -> NDArray[np.float64]:
    """A sweep without its own vehicle."""
    points_ego = sweep.points_ego()
    low, high = np.transpose(VEHICLE_M)
    own = np.all((points_ego > low) & (points_ego < high), -1)
    return frames.apply(sweep.world_from_ego, points_ego[~own])


def _city(parts: dict[str, _Voxels], lattice: Lattice) -> CityHistory:
    voxels = np.concatenate([part.voxels for part in parts.values()])
    blocks = lattice.block_of(voxels)
    block_keys = _keys(blocks)
    order = np.argsort(block_keys, kind="stable")
    starts = np.flatnonzero(np.diff(block_keys[order], prepend=-1))
    drive = np.repeat(np.arange(len(parts), dtype=np.uint16), [len(part.hits) for part in parts.values()])
    return CityHistory(
        lattice,
        tuple(parts),
        blocks[order[starts]],
        np.append(starts, len(order)),
        np.concatenate([part.points_world for part in parts.values()])[order],
        np.concatenate([part.hits for part in parts.values()])[order],
        drive[order],
        len(np.unique(_keys(voxels))),
    )


def _keys(indices: NDArray[np.integer]) -> NDArray[np.int64]:
    """A number for each row (N, 2 or 3) of lattice indices below 2^20 either way, which 400 km are."""
    keys = np.zeros(len(indices), np.int64)
    for column in indices.T:
        keys = keys << 21 | (column.astype(np.int64) + (1 << 20))
    return keys
