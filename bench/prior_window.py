"""Size of a stored tile, and time of writing it and of reading windows from it, on a made-up tile.

Run with `python -m bench.prior_window FOLDER`; about 2 million voxels of 64 channels, 160 MB. Times are of
this process's CPU as well as of the wall, because development machines are shared.
"""

import resource
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from presight_core import frames
from presight_core.priors import PriorReader
from presight_core.priors.documents import GenerationTile
from presight_core.priors.example import ExampleTile
from storage.priors import PriorStore
from storage.tile_groups import TileName

# 1,650 voxels a block are those of a street: ground, kerbs and facades on about a third of the columns.
TILE = ExampleTile(side_blocks=36, voxels_per_block=1650, channel_count=64, drive_count=20, blocks_per_batch=16)
WINDOWS = 60
REACH_M = 170.0  # windows are centred this near to the middle of the tile, so that they are full


def main(folder: Path) -> None:
    """Write the tile, read windows at random poses, print what it took."""
    shutil.rmtree(folder, ignore_errors=True)
    with timed("make the tile's batches, not stored"):
        voxels = sum(len(batch.voxel) for batch in TILE.batches())
    store = PriorStore.open(folder)
    store.create_city("town", TILE.lattice, "space", TILE.channel_count)
    drives = [f"drive-{number}" for number in range(TILE.drive_count)]
    with timed("make and write them"):
        entry = store.write_tile("town", TileName("t000", "build"), TILE.batches(), drives, {})
    tiling = {"tiling_id": "one", "city": "town", "tiles": [{"tile_id": "t000", "centroid_m": [0.0, 0.0]}]}
    store.publish("town", {"t000": GenerationTile(entry, {})}, None, tiling)
    print(f"{voxels:,} voxels, {entry.bytes / voxels:.1f} bytes a voxel")
    for name in sorted(array.name for array in (folder / "town" / entry.path).iterdir() if array.is_dir()):
        size = sum(file.stat().st_size for file in (folder / "town" / entry.path / name).rglob("*") if file.is_file())
        print(f"    {name:12} {size / voxels:7.3f}")
    read_windows(folder)
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3:.0f} MB")


def read_windows(folder: Path) -> None:
    """Print the times of reading windows of the default size, files in the page cache."""
    reader, random = PriorReader.open(folder, "town"), np.random.default_rng(0)
    reader.window(np.eye(4))  # opens the tile
    wall_ms, cpu_ms, voxels = [], [], []
    for _ in range(WINDOWS):
        pose = frames.planar_transform(*random.uniform(-REACH_M, REACH_M, 2), random.uniform(0, 2 * np.pi))
        wall, cpu = time.perf_counter(), time.process_time()
        voxels.append(len(reader.window(pose)))
        wall_ms.append((time.perf_counter() - wall) * 1e3)
        cpu_ms.append((time.process_time() - cpu) * 1e3)
    for name, values in {"wall": wall_ms, "CPU": cpu_ms}.items():
        middle, late = np.percentile(values, [50, 99])
        print(f"window of {np.mean(voxels):,.0f} voxels, {name}: p50 {middle:.0f} ms, p99 {late:.0f} ms")


@contextmanager
def timed(what: str) -> Iterator[None]:
    """Print how long the body took."""
    wall, cpu = time.perf_counter(), time.process_time()
    yield
    print(f"{what}: {time.perf_counter() - wall:.1f} s, {time.process_time() - cpu:.1f} s of CPU")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
