"""How near the hash encoding is to the memory it must read: `python bench/encode.py [--points 65536]`.

The limit is a loop that fetches (forward) or fetches, adds to and stores (gradient) the same table rows, whose
numbers it is given; it knows no positions, hashes or weights. One thread; the variants take turns. Prints
processor milliseconds, least and median of the rounds, for the paper's main grid and at 2^17 rows.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
import torch
from numpy.typing import NDArray

from presight_core.config import GridSettings
from presight_core.field import threads
from presight_core.field.hash_encode import GridLayout, grid_layout, numba_kernels

BLOCK = numba_kernels.BLOCK
SAMPLES = 64  # points come as rays of so many


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=65_536)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "out" / "encode.json")
    options = parser.parse_args()
    threads.use_threads(1)
    threads.keep_freed_memory()
    results = []
    for log2_rows in (17, 20):
        settings = GridSettings(levels=10, features_per_level=4, max_resolution=16384, log2_rows=log2_rows)
        for name, milliseconds in measure(grid_layout(settings), options).items():
            result = {"log2_rows": log2_rows, "what": name, "least_ms": min(milliseconds)}
            results.append(result | {"median_ms": statistics.median(milliseconds)})
            print(f"2^{log2_rows}  {name:16} {result['least_ms']:7.1f} {results[-1]['median_ms']:7.1f}")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")


def measure(layout: GridLayout, options: argparse.Namespace) -> dict[str, list[float]]:
    """Milliseconds of each variant in each round but the first, which compiles."""
    points = rays_points(options.points)
    segments, offsets, levels = np.array([0, len(points)]), layout.offsets().numpy(), layout.levels().numpy()
    table = torch.rand(layout.table_rows, layout.features).numpy()
    gradient = torch.empty_like(torch.from_numpy(table)).numpy()
    encoded = torch.empty(len(points), layout.output_width).numpy()
    by_axis = np.ascontiguousarray(points.T)
    rows = table_rows(by_axis, offsets, levels)
    grid = (by_axis, segments, table, offsets, levels, encoded, 1)
    backward = (by_axis, segments, encoded, offsets, levels, gradient, 1)
    variants: dict[str, Callable[[], None]] = {
        "encode": lambda: numba_kernels.encode(*grid),
        "limit": lambda: gather(rows, table.reshape(-1), encoded.reshape(-1), len(levels)),
        "gradient": lambda: numba_kernels.table_gradient(*backward),
        "gradient limit": lambda: scatter(rows, gradient.reshape(-1), encoded.reshape(-1), len(levels)),
    }
    milliseconds: dict[str, list[float]] = {name: [] for name in variants}
    for _ in range(options.rounds + 1):
        for name, variant in variants.items():
            started = time.process_time()
            variant()
            milliseconds[name].append((time.process_time() - started) * 1000)
    return {name: values[1:] for name, values in milliseconds.items()}


def rays_points(count: int) -> NDArray[np.float32]:
    """Points (count, 3) in the unit cube, along rays of random places and directions."""
    generator = torch.Generator().manual_seed(0)
    origins = torch.rand(count // SAMPLES, 1, 3, generator=generator)
    directions = torch.randn(count // SAMPLES, 1, 3, generator=generator) / 5
    points = origins + directions * torch.linspace(0, 1, SAMPLES)[:, None]
    return points.clamp(0, 0.9999).reshape(-1, 3).contiguous().numpy()


@numba.njit(cache=True)
def table_rows(points, offsets, levels):
    """Rows (levels, blocks, 8, BLOCK) of the whole table that the encoding reads."""
    blocks = points.shape[1] // BLOCK
    rows = np.empty((len(levels), blocks, 8, BLOCK), np.uint32)
    for level in range(len(levels)):
        scratch = numba_kernels.corner_scratch()
        for block in range(blocks):
            numba_kernels._corners(points, block * BLOCK, BLOCK, levels[level], scratch)
            rows[level, block] = scratch[0] + np.uint32(offsets[0, level])
    return rows


@numba.njit(fastmath=True, cache=True)
def gather(rows, table, output, level_count):
    """Add the rows of each point up."""
    ones = np.ones((8, BLOCK), np.float32)
    for level in range(level_count):
        for block in range(rows.shape[1]):
            for i in range(BLOCK):
                place = ((block * BLOCK + i) * level_count + level) * 4
                numba_kernels._gather_rows(output, place, table, rows[level, block], ones, i)


@numba.njit(fastmath=True, cache=True)
def scatter(rows, table, gradient, level_count):
    """Add each point's gradient to its rows, which are zeroed first."""
    ones = np.ones((8, BLOCK), np.float32)
    table[:] = 0
    for level in range(level_count):
        for block in range(rows.shape[1]):
            for i in range(BLOCK):
                place = ((block * BLOCK + i) * level_count + level) * 4
                numba_kernels._scatter_rows(table, gradient, place, rows[level, block], ones, i)


if __name__ == "__main__":
    main()
