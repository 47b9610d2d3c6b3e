"""How fast surfaces are found, beside the forward pass of training: `python bench/extraction.py FIELD`.

FIELD is the folder of a trained field (`field/` in a tile's scratch folder). Random rays from its cameras' boxes near
the horizon; the two take turns, one thread. With `--points N` the sums of N surface points spread over a square
kilometre are made instead, and the peak memory of the process is printed as they grow.
"""

import argparse
import json
import resource
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from presight_core.field import threads
from presight_core.field.checkpoint import load_field
from presight_core.field.surface import find_surface
from presight_core.field.tile_field import Sampling, TileField
from presight_core.grid import Lattice
from stages.voxel_sums import Samples, VoxelSums

RAYS = 8192
CHANNELS = 64
SIDE_M = 1000.0
POINTS_OF_FRAME = 20_000


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("field", type=Path, nargs="?")
    parser.add_argument("--points", type=int)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "out" / "extraction.json")
    options = parser.parse_args()
    threads.use_threads(1)
    threads.keep_freed_memory()
    result = memory(options.points) if options.points else speed(load_field(options.field), options.rounds)
    for name, value in result.items():
        print(f"{name:24} {value:,.2f}")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


def speed(field: TileField, rounds: int) -> dict[str, float]:
    """Rays a processor second of training's forward pass, gradients recorded, and of the surfaces."""
    origins, directions = random_rays(field)
    numbers, passes = np.zeros(RAYS, np.int64), len(field.proposals) + 1
    rates: dict[str, list[float]] = {"forward": [], "first-hit": [], "expected": []}
    for _ in range(rounds + 1):
        started = time.process_time()
        seen = field(field.rays(origins, directions, numbers, numbers), Sampling(torch.rand(RAYS, passes)))
        rates["forward"].append(RAYS / (time.process_time() - started))
        del seen
        for rule in ("first-hit", "expected"):
            started = time.process_time()
            find_surface(field, origins, directions, rule)
            rates[rule].append(RAYS / (time.process_time() - started))
    medians = {f"{name}_rays_per_s": statistics.median(values[1:]) for name, values in rates.items()}
    ratios = [surface / forward for surface, forward in zip(rates["first-hit"], rates["forward"], strict=True)]
    return {**medians, "first_hit_over_forward": statistics.median(ratios[1:])}


def random_rays(field: TileField) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rays from random places at camera height inside the sub-fields' boxes."""
    random, parts = np.random.default_rng(0), field.shape.sub_fields
    centroids = np.array([part.centroid_m for part in parts])
    low, high = (np.array([getattr(part, name) for part in parts]) for name in ("box_min_m", "box_max_m"))
    margin = np.array([15.0, 15.0, 0])  # of a box around its cameras
    chosen = random.integers(len(parts), size=RAYS)
    low, high = np.minimum(low + margin, centroids - 1), np.maximum(high - margin, centroids + 1)
    origins = random.uniform(low[chosen], high[chosen])
    origins[:, 2] = centroids[chosen, 2]
    directions = random.normal(size=(RAYS, 3)) * (1, 1, 0.15) - (0, 0, 0.1)
    return origins, directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def memory(point_count: int) -> dict[str, float]:
    """Peak memory in GiB after each quarter of the points, and once all voxels are read."""
    random, result = np.random.default_rng(0), {}
    with tempfile.TemporaryDirectory() as scratch:
        sums = VoxelSums(Lattice(), CHANNELS, 16, Path(scratch))
        frames = point_count // POINTS_OF_FRAME
        for frame in range(frames):
            sums.add(frame_points(random, frame / frames), frame % 16)
            if (frame + 1) % (frames // 4) == 0:
                result[f"gib_at_{(frame + 1) * POINTS_OF_FRAME:,}"] = peak_gib()
        voxels, dropped = sums.finish(2)
        for superblock in sums.superblocks:
            sums.means(superblock)
    return result | {"gib_at_the_end": peak_gib(), "voxels": float(voxels), "dropped": float(dropped)}


def frame_points(random: np.random.Generator, progress: float) -> Samples:
    """Points around a car that drives rows through the square."""
    row, along = divmod(progress * 20, 1)
    centre = np.array([along * SIDE_M, row * SIDE_M / 20, 0])
    points = centre + random.normal(size=(POINTS_OF_FRAME, 3)) * (20, 20, 2)
    unit = random.random((POINTS_OF_FRAME, CHANNELS + 4), np.float32)
    return Samples(points, unit[:, :CHANNELS], unit[:, CHANNELS : CHANNELS + 3], unit[:, -1])


def peak_gib() -> float:
    """Peak memory of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


if __name__ == "__main__":
    main()
