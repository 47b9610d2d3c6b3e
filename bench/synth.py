"""How fast the synthetic city is built and rendered: `python bench/synth.py [--sizes 400 800 1600] [--rounds 5]`.

Whole rigs of six cameras at random places; day and night, with and without antialiasing, 1 and 2 threads take turns,
so that a busy machine harms all alike. Prints a table, and writes it as JSON to bench/out/synth.json.
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from presight_core.cameras import Camera
from presight_core.synthetic.city import City
from presight_core.synthetic.renderer import Renderer
from presight_core.synthetic.shadow import Shadows
from presight_core.synthetic.views import View, random_view


@dataclass(frozen=True)
class Case:
    """One row of the table."""

    width_px: int
    light: str
    antialias: bool
    threads: int

    @property
    def name(self) -> str:
        samples = "antialiased" if self.antialias else "plain"
        return f"{self.width_px} px, {self.light}, {samples}, {self.threads} threads"


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[400], help="image widths in pixels")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "out" / "synth.json")
    parser.add_argument("--first-image", action="store_true", help="render one small rig, print nothing")
    options = parser.parse_args()
    if options.first_image:
        render_first_image()
        return
    result: dict[str, float] = {"first_image_s": first_image_s()}
    started = time.perf_counter()
    city = City(seed=3)
    result["city_s"] = time.perf_counter() - started
    result |= rigs_per_s(city, options.sizes, options.rounds)
    result["peak_memory_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    for name, value in result.items():
        print(f"{name:56} {value:8.2f}")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


def first_image_s() -> float:
    """Seconds of a new process without compiled kernels up to its first small image."""
    with tempfile.TemporaryDirectory() as kernels:
        started = time.perf_counter()
        command = [sys.executable, __file__, "--first-image"]
        subprocess.run(command, check=True, env=os.environ | {"NUMBA_CACHE_DIR": kernels})
        return time.perf_counter() - started


def render_first_image() -> None:
    """One small rig."""
    city = City(seed=0)
    view = random_view(city, np.random.default_rng(0), 64, "day")
    Renderer(city).render(view.cameras, view.lighting, view.actors)


def rigs_per_s(city: City, sizes: list[int], rounds: int) -> dict[str, float]:
    """Median rigs a second of every case, by the clock and by processor time."""
    cases = [Case(*values) for values in product(sizes, ("day", "night"), (True, False), (1, 2))]
    times: dict[Case, list[tuple[float, float]]] = {case: [] for case in cases}
    for number in range(-1, rounds):  # the first round warms up
        for case in cases:
            seconds = seconds_a_rig(city, case, number + 1)
            if number >= 0:
                times[case].append(seconds)
    result = {}
    for case, pairs in times.items():
        wall, processor = zip(*pairs, strict=True)
        result[f"{case.name}, rigs/s"] = 1 / statistics.median(wall)
        result[f"{case.name}, rigs/processor s"] = 1 / statistics.median(processor)
    return result


def seconds_a_rig(city: City, case: Case, seed: int) -> tuple[float, float]:
    """Wall and processor time of one rig, its images shared among the threads; city shadows are made once a drive."""
    renderer = Renderer(city, case.antialias)
    view = random_view(city, np.random.default_rng(seed), case.width_px, case.light)
    shadows = renderer.cast_shadows(view.lighting, view.cameras[0].world_from_camera[:3, 3])
    with ThreadPoolExecutor(case.threads) as pool:
        wall, processor = time.perf_counter(), time.process_time()
        list(pool.map(lambda camera: shoot(renderer, view, camera, shadows), view.cameras))
        return time.perf_counter() - wall, time.process_time() - processor


def shoot(renderer: Renderer, view: View, camera: Camera, shadows: Shadows) -> None:
    """One image, as data sets are made."""
    renderer.render([camera], view.lighting, view.actors, shadows, ego=view.world_from_ego)


if __name__ == "__main__":
    main()
