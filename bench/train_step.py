"""How fast a whole training step is: `python bench/train_step.py [--preset fast] [--threads 1]`.

Random rays along a made-up street; the shape (batch, samples, tables, networks) is that of the preset. With
`--peer PYTHON`, the interpreter of an environment that has nerfstudio 1.1.5, its nerfacto in torch mode takes
turns with ours at the same sizes. Prints a table, and writes
it as JSON to bench/out/train_step.json.
"""

import argparse
import json
import statistics
import subprocess
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from presight_core import classes
from presight_core.config import CitySettings, load_city_settings
from presight_core.drives import FrameTable
from presight_core.field import threads
from presight_core.frames import planar_transform
from stages.ray_pool import PixelBatch
from stages.tiling import sub_fields
from stages.training import Run, TileTraining, training_rows

STREET_M = 200.0
FRAMES = 64
CHANNELS = 64  # paper
WARM_UP = 3  # steps: kernels load and memory grows


@dataclass
class Stopwatch:
    """Wall and processor seconds of steps."""

    wall: list[float] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)

    def time(self, call) -> None:
        """Run and note one call."""
        wall, processor = time.perf_counter(), time.process_time()
        call()
        self.wall.append(time.perf_counter() - wall)
        self.processor.append(time.process_time() - processor)


class Peer:
    """Another implementation in its own environment, which does a step when told to."""

    def __init__(self, python: str, job: TileTraining, thread_count: int) -> None:
        command = [python, "-W", "ignore", str(Path(__file__).with_name("peer.py"))]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.parameters = self._ask(peer_shape(job.settings, thread_count))["parameters"]

    def step(self, watch: Stopwatch) -> None:
        """One step; its times are noted."""
        seconds = self._ask({})
        watch.wall.append(seconds["wall"])
        watch.processor.append(seconds["processor"])

    def close(self) -> None:
        """End the process."""
        self._process.communicate()

    def _ask(self, question: dict) -> dict:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(question) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--set", action="append", default=[], help="a setting, section.name=value")
    parser.add_argument("--peer", help="python of an environment with nerfstudio 1.1.5")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "out" / "train_step.json")
    options = parser.parse_args()
    settings = load_city_settings(None, [f"preset={options.preset}", *options.set])
    threads.use_threads(options.threads)
    threads.keep_freed_memory()
    frames = street()
    job = TileTraining("bench", frames, sub_fields(frames.positions, settings.tiling), settings, CHANNELS)
    with tempfile.TemporaryDirectory() as scratch:
        run = Run(job, Path(scratch))
        measured = measure(run, job, options)
    result = {"preset": options.preset, "threads": options.threads, "batch_rays": settings.training.batch_rays}
    result |= measured
    for name, value in result.items():
        print(f"{name:28} {value if isinstance(value, str | int) else f'{value:,.1f}'}")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


def measure(run: Run, job: TileTraining, options: argparse.Namespace) -> dict[str, float]:
    """Whole steps of ours, and in turn of the peer if there is one."""
    ours, theirs = Stopwatch(), Stopwatch()
    peer = Peer(options.peer, job, options.threads) if options.peer else None
    first = job.settings.training.steps // 2  # past the warm-up, where the proposals learn every fifth step
    for step in range(first, first + WARM_UP + options.steps):
        batch = random_batch(job, step)
        ours.time(lambda step=step, batch=batch: run.train(step, batch))
        if peer:
            peer.step(theirs)
    result = figures(ours, job, "")
    result["parameters"] = sum(parameter.numel() for parameter in run.field.parameters())
    if peer:
        peer.close()
        result |= figures(theirs, job, "peer_")
        result["peer_parameters"] = peer.parameters
        result["times_the_peer"] = result["rays_per_processor_s"] / result["peer_rays_per_processor_s"]
    return result


def figures(watch: Stopwatch, job: TileTraining, prefix: str) -> dict[str, float]:
    """Means of steps after the warm-up, the slowest tenth left out: milliseconds and rays a second."""
    means = {}
    for name in ("wall", "processor"):
        seconds = sorted(getattr(watch, name)[WARM_UP:])
        means[name] = statistics.fmean(seconds[: len(seconds) - max(1, len(seconds) // 10)])
    rays = job.settings.training.batch_rays
    return {
        f"{prefix}step_wall_ms": means["wall"] * 1000,
        f"{prefix}step_processor_ms": means["processor"] * 1000,
        f"{prefix}rays_per_s": rays / means["wall"],
        f"{prefix}rays_per_processor_s": rays / means["processor"],
    }


def peer_shape(settings: CitySettings, thread_count: int) -> dict:
    """The sizes that the peer shall have too."""
    field_settings, sampling = settings.field, settings.sampling
    return {
        "threads": thread_count,
        "batch_rays": settings.training.batch_rays,
        "frames": FRAMES,
        "near_m": sampling.near_m,
        "far_m": sampling.far_m,
        "grid": field_settings.grid.model_dump(),
        "proposals": [grid.model_dump() for grid in field_settings.proposals],
        "hidden_width": field_settings.hidden_width,
        "proposal_width": field_settings.proposal_width,
        "proposal_samples": sampling.proposal_samples,
        "field_samples": sampling.field_samples,
        "embedding": field_settings.video_embedding + field_settings.image_embedding,
    }


def street() -> FrameTable:
    """Cameras along a straight street, looking ahead."""
    poses = np.stack([planar_transform(x, 0, 0) for x in np.linspace(0, STREET_M, FRAMES)])
    ego_from_camera = np.array([[0, 0, 1, 1.5], [-1, 0, 0, 0], [0, -1, 0, 1.6], [0, 0, 0, 1]])
    intrinsics = np.array([[250.0, 0, 200], [0, 250, 112.5], [0, 0, 1]])
    return FrameTable(
        drive_id=np.full(FRAMES, "drive"),
        camera=np.full(FRAMES, "CAM_FRONT"),
        timestamp_us=np.arange(FRAMES) * 500_000,
        path=np.array([f"{i}.jpg" for i in range(FRAMES)]),
        file_bytes=np.zeros(FRAMES, np.int64),
        width_px=np.full(FRAMES, 400, np.int32),
        height_px=np.full(FRAMES, 225, np.int32),
        intrinsics=np.tile(intrinsics, (FRAMES, 1, 1)),
        world_from_camera=poses @ ego_from_camera,
        is_keyframe=np.ones(FRAMES, np.bool_),
    )


def random_batch(job: TileTraining, seed: int) -> PixelBatch:
    """Rays of random frames in all directions near the horizon, with random targets."""
    random = np.random.default_rng(seed)
    count = job.settings.training.batch_rays
    rows = random.choice(training_rows(job.frames, job.settings.training), count)
    directions = random.normal(size=(count, 3)) * (1, 1, 0.2)
    return PixelBatch(
        rows,
        job.frames.positions[rows],
        directions / np.linalg.norm(directions, axis=-1, keepdims=True),
        random.random(count),
        random.integers(256, size=(count, 3)).astype(np.uint8),
        random.integers(classes.SKY + 1, size=count).astype(np.uint8),
        random.integers(256, size=(count, CHANNELS)).astype(np.uint8),
    )


if __name__ == "__main__":
    main()
