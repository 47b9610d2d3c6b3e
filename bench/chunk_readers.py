"""The chunks of a window, read by four libraries in turns: ours, zarr-python, its zarrs pipeline, TensorStore.

Run with `OMP_NUM_THREADS=1 python -m bench.chunk_readers STORE CITY [WINDOWS]` after `pip install zarrs tensorstore`.
Each reads the same runs of whole chunks of the six voxel arrays, the files in the page cache, no cache of its own.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from bench.prior_window import X_M, Y_M, Z_M, report, street_poses
from presight_core.priors import PriorReader
from presight_core.priors.tile_table import LOOK_ARRAYS, PLACE_ARRAYS, TileTable
from presight_core.priors.window import WindowBox

ARRAYS = PLACE_ARRAYS + LOOK_ARRAYS
Runs = dict[str, list[tuple[int, int]]]  # first and last chunk of every run, by array


def main(location: str, city: str, window_count: int) -> None:
    """Print the times of each library."""
    reader = PriorReader.open(location, city, cache_bytes=0)
    libraries: dict[str, Callable[[TileTable, Runs], Any]] = {"ours": read_ours}
    libraries["zarr-python"] = ZarrReader(Path(location))
    for name, make in {"zarr-python with zarrs": zarrs_reader, "TensorStore": TensorStoreReader}.items():
        try:
            libraries[name] = make(Path(location))
        except ImportError as error:
            print(f"{name}: left out, {error}")
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in libraries}
    chunk_counts = []
    for pose in street_poses(reader, window_count):
        windows = [(table, runs) for table, runs in needed(reader, pose) if any(runs.values())]
        chunk_counts.append(sum(b - a + 1 for _, runs in windows for spans in runs.values() for a, b in spans))
        for table, runs in windows:
            read_ours(table, runs)  # so that none of them is the one that waits for the disk
        for name, read in libraries.items():
            for table, _ in windows:
                read(table, {key: [] for key in ARRAYS})  # opens the arrays
            wall, cpu = time.perf_counter(), time.process_time()
            for table, runs in windows:
                read(table, runs)
            times[name].append((time.perf_counter() - wall, time.process_time() - cpu))
    for name, values in times.items():
        report(name, values)
    print(f"chunks a window: median {np.median(chunk_counts):.0f}")


def needed(reader: PriorReader, pose: NDArray) -> list[tuple[TileTable, Runs]]:
    """For each tile, the runs of chunks that hold voxels of the blocks around a window."""
    blocks = WindowBox.at(pose, X_M, Y_M, Z_M).blocks(reader.lattice)
    result = []
    for tile_id in reader.tiles:
        table = reader.tile(tile_id)
        rows = table.rows_of(table.find(blocks))
        result.append((table, {name: runs_of(rows // table.arrays[name].spec.chunk_rows) for name in ARRAYS}))
    return result


def runs_of(chunks: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Runs of neighbouring numbers."""
    numbers = np.unique(chunks)
    if not len(numbers):
        return []
    parts = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    return [(int(part[0]), int(part[-1])) for part in parts]


def read_ours(table: TileTable, runs: Runs) -> None:
    """The reader's own way."""
    table.load([(name, number) for name, spans in runs.items() for a, b in spans for number in range(a, b + 1)])


class ZarrReader:
    """zarr-python, one thread."""

    def __init__(self, location: Path) -> None:
        self.location = location
        self.arrays: dict[str, zarr.Array] = {}

    def __call__(self, table: TileTable, runs: Runs) -> None:
        with zarr.config.set({"threading.max_workers": 1}):
            for name, spans in runs.items():
                array, size = self.opened(table, name), table.arrays[name].spec.chunk_rows
                for a, b in spans:
                    np.asarray(array[a * size : (b + 1) * size])

    def opened(self, table: TileTable, name: str) -> zarr.Array:
        """An array, opened once."""
        path = f"{table.name}/{name}"
        if path not in self.arrays:
            self.arrays[path] = zarr.open_array(self.location / path, mode="r")
        return self.arrays[path]


def zarrs_reader(location: Path) -> Callable[[TileTable, Runs], None]:
    """zarr-python with the codec pipeline in Rust."""
    import zarrs  # noqa: F401 # pyright: ignore[reportMissingImports]

    reader = ZarrReader(location)

    def read(table: TileTable, runs: Runs) -> None:
        with zarr.config.set({"codec_pipeline.path": "zarrs.ZarrsCodecPipeline"}):
            reader(table, runs)

    return read


class TensorStoreReader:
    """TensorStore, all runs asked for at once, one thread for copies and one for files."""

    def __init__(self, location: Path) -> None:
        import tensorstore  # pyright: ignore[reportMissingImports]

        self.location, self.library = location, tensorstore
        limits = {"data_copy_concurrency": {"limit": 1}, "file_io_concurrency": {"limit": 1}}
        self.context = tensorstore.Context(limits)
        self.arrays: dict[str, Any] = {}

    def __call__(self, table: TileTable, runs: Runs) -> None:
        waiting = []
        for name, spans in runs.items():
            path, size = f"{table.name}/{name}", table.arrays[name].spec.chunk_rows
            if path not in self.arrays:
                spec = {"driver": "zarr3", "kvstore": {"driver": "file", "path": f"{self.location / path}/"}}
                self.arrays[path] = self.library.open(spec, context=self.context, read=True).result()
            array = self.arrays[path]
            waiting += [array[a * size : min((b + 1) * size, array.shape[0])].read() for a, b in spans]
        for future in waiting:
            future.result()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]) if len(sys.argv) > 3 else 60)
