"""What perception pays beside its models: voxels of a prior, and evaluation, in time and memory.

Run with `python -m bench.perception_data FOLDER`, FOLDER being one that `bench.prior_window` wrote, with perception/
on the path. Times are of this process's CPU, on one thread.
"""

import resource
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch

from presight_core import frames
from presight_perception.dataset import AugmentationRange, CityPriors, Place, PriorDataset, PriorSettings
from presight_perception.fusion import PriorFusion2D, PriorFusion3D
from presight_perception.metrics import OccupancyIou, ScoredLines, VectorPrecision
from presight_perception.occupancy_truth import OccupancyTruth
from presight_perception.voxelise import MAPPING_GRID, OCCUPANCY_GRID, VoxelDrop, voxelise, voxelise_tensors

REACH_M = 150.0  # from the middle of the tile, so that windows are full
OCCUPANCY_SAMPLES = 6_019  # of the official validation split
VECTOR_SAMPLES = 60


def main(folder: Path) -> None:
    """Print a line for each part."""
    torch.set_num_threads(1)
    random = np.random.default_rng(0)
    poses = [
        frames.planar_transform(*random.uniform(-REACH_M, REACH_M, 2), random.uniform(0, 2 * np.pi)) for _ in range(20)
    ]
    voxels(folder, [Place("town", pose) for pose in poses])
    fusion()
    vectors(random)
    occupancy(random)


def voxels(folder: Path, places: list[Place]) -> None:
    """Samples of both grids, read and then from the cache."""
    priors = CityPriors(folder, {"town": None})
    turns = AugmentationRange(0.39, (0.95, 1.05), flips=True)  # 22.5 degrees, as FB-OCC
    for name, settings in {
        "mapping": PriorSettings(MAPPING_GRID),
        "mapping, augmented": PriorSettings(MAPPING_GRID, augmentation=turns, drop=VoxelDrop()),
        "occupancy, augmented": PriorSettings(OCCUPANCY_GRID, augmentation=turns, drop=VoxelDrop()),
    }.items():
        dataset = PriorDataset(priors, places, settings)
        for state in ("read", "cached"):
            took_ms = [_cpu_ms(partial(dataset.__getitem__, index)) for index in range(len(places))]
            print(f"{name}, {state}: {np.median(took_ms):.0f} ms a sample")
    points = priors.points(places[0], PriorSettings().window_ranges())
    given = (points.points_ego, points.features, points.weights)
    tensors = [torch.from_numpy(part) for part in given]
    count = len(voxelise(*given, MAPPING_GRID).features)
    numpy_ms = min(_cpu_ms(lambda: voxelise(*given, MAPPING_GRID)) for _ in range(5))
    torch_ms = min(_cpu_ms(lambda: voxelise_tensors(*tensors, MAPPING_GRID)) for _ in range(5))
    print(f"{len(given[0]):,} points to {count:,} voxels: numpy {numpy_ms:.0f} ms, torch {torch_ms:.0f} ms")


def fusion() -> None:
    """The full-sized fusion modules on one thread."""
    sizes = {"2D": (PriorFusion2D(), (1, 256, 50, 100)), "3D": (PriorFusion3D(), (1, 64, 200, 200, 16))}
    row = torch.arange(20_000)  # of voxels: a street's; two high on 125 x 80 columns
    coordinates = torch.stack([torch.zeros_like(row), row // 160, row // 2 % 80, row % 2], 1)
    for name, (module, shape) in sizes.items():
        run = partial(module.eval(), torch.zeros(shape), torch.zeros(len(row), 68), coordinates)
        with torch.no_grad():
            print(f"fusion {name}, forward: {_cpu_ms(run):.0f} ms")


def vectors(random: np.random.Generator) -> None:
    """Average precision of 100 predictions and 20 true lines a sample."""
    precision = VectorPrecision()

    def lines(count: int) -> list[np.ndarray]:
        start = random.uniform((-50, -25), (50, 25), (count, 1, 2))
        return list(start + np.cumsum(random.normal(0, 1.5, (count, 20, 2)), 1))

    samples = [
        (
            ScoredLines(lines(100), random.integers(0, 3, 100), random.random(100)),
            {"divider": lines(10), "boundary": lines(10)},
        )
        for _ in range(VECTOR_SAMPLES)
    ]
    took_ms = [_cpu_ms(partial(precision.add, *sample)) for sample in samples]
    print(f"vector precision: {np.mean(took_ms):.0f} ms a sample")


def occupancy(random: np.random.Generator) -> None:
    """A whole evaluation of full-sized samples."""
    semantics = random.integers(0, 18, (200, 200, 16), np.uint8)
    truth = OccupancyTruth(semantics, random.random(semantics.shape) < 0.4, np.ones(semantics.shape, np.bool_))
    iou = OccupancyIou()
    before = _peak_mb()
    seconds = _cpu_ms(lambda: [iou.add(semantics, truth) for _ in range(OCCUPANCY_SAMPLES)]) / 1e3
    print(
        f"occupancy of {OCCUPANCY_SAMPLES:,} samples: {seconds:.0f} s; "
        f"peak memory of this process {_peak_mb():.0f} MB, {before:.0f} MB before"
    )


def _cpu_ms(run: Callable[[], object]) -> float:
    start = time.process_time()
    run()
    return (time.process_time() - start) * 1e3


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


if __name__ == "__main__":
    main(Path(sys.argv[1]))
