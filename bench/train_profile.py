"""What a training step spends its time on: `python bench/train_profile.py [--set section.name=value]`.

The parts are timed by their names in this project's modules, one thread, processor time; the preset is `paper` with
one sub-field and 1,024 rays unless set. What no part accounts for is the rest.
"""

import argparse
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from train_step import CHANNELS, WARM_UP, random_batch, street

from presight_core.config import load_city_settings
from presight_core.field import hash_encode, mlp, ray_density, rendering, samplers, threads
from presight_core.field.tile_field import TileField
from stages.tiling import sub_fields
from stages.training import Run, TileTraining

PARTS = (
    ("encode", hash_encode.numba_kernels, "encode"),
    ("encode, gradient", hash_encode.numba_kernels, "table_gradient"),
    ("proposals that do not learn, in one pass", ray_density, "ray_density"),
    ("networks", mlp._BlockwiseLayers, "forward"),
    ("networks, gradient", mlp._BlockwiseLayers, "backward"),
    ("positions and sub-fields", TileField, "_locate"),
    ("sampling", samplers, "resample"),
    ("sampling", samplers.Spacing, "metres"),
    ("rendering, forward", rendering, "ray_weights"),
    ("rendering, forward", rendering, "blend"),
    ("losses, forward", Run, "_losses"),
)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--steps", type=int, default=10)
    parser.add_argument("--set", action="append", default=["training.batch_rays=1024", "tiling.sub_field_count=1"])
    options = parser.parse_args()
    threads.use_threads(1)
    threads.keep_freed_memory()
    settings, frames = load_city_settings(None, [f"preset={options.preset}", *options.set]), street()
    job = TileTraining("bench", frames, sub_fields(frames.positions, settings.tiling), settings, CHANNELS)
    seconds: dict[str, float] = defaultdict(float)
    for part, owner, name in PARTS:
        watch(seconds, part, owner, name)
    with tempfile.TemporaryDirectory() as scratch:
        run = Run(job, Path(scratch))
        watch(seconds, "optimiser", run._optimiser, "step")
        first = settings.training.steps // 2
        for step in range(first, first + WARM_UP + options.steps):
            if step == first + WARM_UP:
                seconds.clear()
            batch = random_batch(job, step)
            started = time.process_time()
            run.train(step, batch)
            seconds["whole step"] += time.process_time() - started
    whole = seconds.pop("whole step")
    seconds["rest"] = whole - sum(seconds.values())
    for part, spent in sorted(seconds.items(), key=lambda item: -item[1]):
        print(f"{part:40} {spent / options.steps * 1000:7.1f} ms {spent / whole:6.1%}")
    print(f"{'whole step':40} {whole / options.steps * 1000:7.1f} ms")


def watch(seconds: dict[str, float], part: str, owner: Any, name: str) -> None:
    """Add the time of each call of owner.name to a part."""
    call: Callable[..., Any] = getattr(owner, name)

    def timed(*arguments: Any, **options: Any) -> Any:
        started = time.process_time()
        try:
            return call(*arguments, **options)
        finally:
            seconds[part] += time.process_time() - started

    setattr(owner, name, staticmethod(timed) if isinstance(owner, type) and owner is mlp._BlockwiseLayers else timed)


if __name__ == "__main__":
    main()
