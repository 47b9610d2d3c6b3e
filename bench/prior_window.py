"""Time of a 100 x 50 m window from a large city, beside a loader that scans the whole city from memory.

Run with `OMP_NUM_THREADS=1 python -m bench.prior_window STORE CITY [WINDOWS]`; `bench.prior_city` makes the city.
The kinds of read take turns at each place, so that all meet the same noise of a shared machine.
"""

import os
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from presight_core import frames
from presight_core.priors import PriorReader

X_M, Y_M, Z_M = (-50.0, 50.0), (-25.0, 25.0), (-3.0, 5.0)
COLD, WARM, SCAN = "nothing in the cache of the reader", "the same window again", "the scanning loader"
TRIES = 4  # at each place: the least of them is what the load of other processes disturbs least
LENGTH_M = {"x": X_M, "y": Y_M, "z": Z_M}


@dataclass(frozen=True)
class ScanningLoader:
    """What the released loader does, in plain numpy: every voxel of the city in memory, every one looked at."""

    points: NDArray[np.float32]  # (N, 3) world metres
    features: NDArray[np.float16]  # (N, C)
    hits: NDArray[np.float32]  # (N,)

    @staticmethod
    def of(reader: PriorReader) -> "ScanningLoader":
        """The whole city in memory, in the released dtypes."""
        count = sum(tile.entry.voxel_count for tile in reader.generation.tiles.values())
        points, first = np.empty((count, 3), np.float32), 0
        features, hits = np.empty((count, reader.channel_count), np.float16), np.empty(count, np.float32)
        for tile_id in reader.tiles:
            table = reader.tile(tile_id)
            last = first + int(table.block_start[-1])
            points[first:last] = table.points()
            features[first:last] = table.all_rows("features")
            hits[first:last] = table.all_rows("hits")
            first = last
        return ScanningLoader(points, features, hits)

    def window(self, world_from_ego: NDArray[np.float64]) -> tuple[NDArray, NDArray, NDArray]:
        """Points in the ego frame, features and hits of the voxels in the box."""
        corners = np.stack(np.meshgrid(X_M, Y_M, (0.0,)), -1).reshape(-1, 3)
        world = frames.apply(world_from_ego, corners)
        (left, bottom), (right, top) = world.min(0)[:2], world.max(0)[:2]
        x, y = self.points[:, 0], self.points[:, 1]
        near = np.flatnonzero((x >= left) & (x <= right) & (y >= bottom) & (y <= top))
        points = frames.apply(frames.invert(world_from_ego), self.points[near].astype(np.float64))
        low, high = np.transpose(list(LENGTH_M.values()))
        inside = np.all((points >= low) & (points < high), -1)
        kept = near[inside]
        return points[inside], self.features[kept], self.hits[kept]

    @property
    def size_bytes(self) -> int:
        """What every worker that holds a copy pays."""
        return self.points.nbytes + self.features.nbytes + self.hits.nbytes


def main(location: str, city: str, window_count: int) -> None:
    """Print the times of all kinds of read."""
    before = resident_bytes()
    reader = PriorReader.open(location, city)
    for tile_id in reader.tiles:
        reader.tile(tile_id)
    poses = street_poses(reader, window_count)
    report("no page of the store in memory", read_from_disk(Path(location), reader, poses))
    print(f"the reader: {(resident_bytes() - before) / 1e6:.0f} MB resident, {open_files()} open files")
    loader = ScanningLoader.of(PriorReader.open(location, city, cache_bytes=0))
    print(f"the scanning loader: {loader.size_bytes / 1e6:,.0f} MB of arrays, {len(loader.hits):,} voxels")
    kinds: dict[str, Callable[[NDArray], object]] = {COLD: reader.window, WARM: reader.window, SCAN: loader.window}
    first: dict[str, list[tuple[float, float]]] = {name: [] for name in kinds}
    least: dict[str, list[tuple[float, float]]] = {name: [] for name in kinds}
    voxels = []
    for pose in poses:
        tries: dict[str, list[tuple[float, float]]] = {name: [] for name in kinds}
        for _ in range(TRIES):
            reader.forget()
            for name, read in kinds.items():
                wall, cpu = time.perf_counter(), time.process_time()
                read(pose)
                tries[name].append((time.perf_counter() - wall, time.process_time() - cpu))
        for name, values in tries.items():
            first[name].append(values[0])
            least[name].append(min(values))
        window = reader.window(pose)
        difference = abs(len(window) - len(loader.window(pose)[2]))
        assert difference <= 5, "both find the same voxels, but for single precision at the borders"
        voxels.append(len(window))
    for name in kinds:
        report(name, first[name])
        report(f"  least of {TRIES} tries", least[name])
    print(f"voxels a window: median {np.median(voxels):,.0f}, most {max(voxels):,}")


def street_poses(reader: PriorReader, count: int) -> list[NDArray[np.float64]]:
    """Random headings at random places of random mapped blocks."""
    random = np.random.default_rng(0)
    blocks = np.concatenate([reader.tile(tile_id).block_index for tile_id in reader.tiles])
    places = (blocks[random.integers(len(blocks), size=count)] + random.random((count, 2))) * reader.lattice.block_m
    return [frames.planar_transform(x, y, random.uniform(0, 2 * np.pi)) for x, y in places]


def read_from_disk(location: Path, reader: PriorReader, poses: list[NDArray]) -> list[tuple[float, float]]:
    """Times with the operating system's cache emptied of the store before every tenth window."""
    times = []
    for number, pose in enumerate(poses[: len(poses) // 2]):
        reader.forget()
        if number % 10 == 0:
            drop_pages(location)
        wall, cpu = time.perf_counter(), time.process_time()
        reader.window(pose)
        times.append((time.perf_counter() - wall, time.process_time() - cpu))
    return times


def drop_pages(folder: Path) -> None:
    """Take a folder's files out of the operating system's cache."""
    os.sync()
    for file in folder.rglob("*"):
        if file.is_file():
            with file.open("rb") as opened:
                os.posix_fadvise(opened.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def report(name: str, times: list[tuple[float, float]]) -> None:
    """Print the median and the 99th percentile, milliseconds of the wall and of this process's CPU."""
    (wall, cpu), (wall_late, cpu_late) = np.percentile(np.array(times) * 1e3, [50, 99], axis=0)
    print(f"{name:36} p50 {wall:7.2f} ms (CPU {cpu:7.2f}), p99 {wall_late:7.2f} ms (CPU {cpu_late:7.2f})")


def resident_bytes() -> int:
    """Memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def open_files() -> int:
    """Open descriptors of this process."""
    return len(list(Path("/proc/self/fd").iterdir()))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]) if len(sys.argv) > 3 else 200)
