"""How fast surfaces are found, beside the forward pass of training: `python bench/extraction.py FIELD`.

FIELD is the folder of a trained field (`field/` in a tile's scratch folder). Both see what they see at work, from
places in its cameras' boxes: training random rays near the horizon, extraction every fourth pixel of images, some at a
time, without features: the presets for CPUs take those of images. The two take turns, one thread. With `--points N`
the sums of N surface points spread over a square kilometre are made instead, and the peak memory of the process is
printed as they grow.
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

from presight_core.config import SurfaceRule
from presight_core.field import threads
from presight_core.field.checkpoint import load_field
from presight_core.field.surface import find_surface
from presight_core.field.tile_field import Sampling, TileField
from presight_core.grid import Lattice
from stages.voxel_sums import Samples, VoxelSums

RAYS = 8192
IMAGES = 6  # at a time: stages.extraction.RAYS_TOGETHER
IMAGE_PX = 100, 41  # every fourth pixel of 400 x 225, less the sky
HALF_VIEW = 0.7  # tangent of half the angle of view: 70 degrees
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
    random = np.random.default_rng(0)
    origins, directions = random_rays(field, random)
    images = [np.concatenate(rays) for rays in zip(*(image_rays(field, random) for _ in range(IMAGES)), strict=True)]
    numbers, passes = np.zeros(RAYS, np.int64), len(field.proposals) + 1
    rules: tuple[SurfaceRule, ...] = ("first-hit", "expected", "span")
    rates: dict[str, list[float]] = {name: [] for name in ("forward", *rules)}
    for _ in range(rounds + 1):
        started = time.process_time()
        seen = field(field.rays(origins, directions, numbers, numbers), Sampling(torch.rand(RAYS, passes)))
        rates["forward"].append(RAYS / (time.process_time() - started))
        del seen
        for rule in rules:
            started = time.process_time()
            find_surface(field, images[0], images[1], rule, with_features=False)
            rates[rule].append(len(images[0]) / (time.process_time() - started))
    medians = {f"{name}_rays_per_s": statistics.median(values[1:]) for name, values in rates.items()}
    ratios = {
        f"{rule}_over_forward": [
            surface / forward for surface, forward in zip(rates[rule], rates["forward"], strict=True)
        ]
        for rule in rules
    }
    return {**medians, **{name: statistics.median(values[1:]) for name, values in ratios.items()}}


def random_rays(field: TileField, random: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rays from random places, in random directions near the horizon."""
    directions = random.normal(size=(RAYS, 3)) * (1, 1, 0.15) - (0, 0, 0.1)
    return random_places(field, random, RAYS), directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def image_rays(field: TileField, random: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rays of the lower half of an image and a little more, row by row: extraction leaves out the sky."""
    columns, rows = IMAGE_PX
    across, down = np.meshgrid(np.linspace(-1, 1, columns) * HALF_VIEW, np.linspace(-0.2, 1, rows) * HALF_VIEW / 2)
    yaw_rad = random.uniform(0, 2 * np.pi)
    ahead, right = np.array([np.cos(yaw_rad), np.sin(yaw_rad), 0]), np.array([np.sin(yaw_rad), -np.cos(yaw_rad), 0])
    directions = ahead + across.reshape(-1, 1) * right - down.reshape(-1, 1) * [0, 0, 1]
    origins = np.broadcast_to(random_places(field, random, 1), directions.shape)
    return origins, directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def random_places(field: TileField, random: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Places (count, 3) at camera height inside the sub-fields' boxes."""
    parts = field.shape.sub_fields
    centroids = np.array([part.centroid_m for part in parts])
    low, high = (np.array([getattr(part, name) for part in parts]) for name in ("box_min_m", "box_max_m"))
    margin = np.array([15.0, 15.0, 0])  # of a box around its cameras
    chosen = random.integers(len(parts), size=count)
    low, high = np.minimum(low + margin, centroids - 1), np.maximum(high - margin, centroids + 1)
    places = random.uniform(low[chosen], high[chosen])
    places[:, 2] = centroids[chosen, 2]
    return places


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
