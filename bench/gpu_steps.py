"""Sections of `bench/gpu.py` about whole steps and extraction."""

import statistics
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from gpu_sizes import Bench, Result

from presight_core import classes
from presight_core.drives import FrameTable
from presight_core.field.surface import find_surface
from presight_core.field.tile_field import TileField
from presight_core.frames import planar_transform
from presight_core.pixels import FramePixels, PixelSource
from presight_core.tiles import SubField
from stages.card_training import EAGER_STEPS, CardRun
from stages.training import TileTraining

CHANNELS = 64  # paper
STREET_M = 400.0


class Noise(PixelSource):
    """Images of noise in the shape of the paper's: the cost of a step does not depend on what they show."""

    def __init__(self, bench: Bench) -> None:
        self._size = (900, 1600) if bench.is_paper else (9, 16)

    def load(self, row: int) -> FramePixels:
        """Seeded by the row."""
        random, (height, width) = np.random.default_rng(row), self._size
        return FramePixels(
            random.integers(256, size=(height, width, 3), dtype=np.uint8),
            random.integers(classes.SKY + 1, size=(height // 2, width // 2), dtype=np.uint8),
            random.integers(256, size=(height // 8, width // 8, CHANNELS), dtype=np.uint8),
        )


def new_run(bench: Bench, scratch: Path, replays: bool, copies: bool = False) -> CardRun:
    """A run of the paper's size along a straight street of noise."""
    count = 64 if bench.is_paper else 4
    ego_from_camera = np.array([[0, 0, 1, 1.5], [-1, 0, 0, 0], [0, -1, 0, 1.6], [0, 0, 0, 1.0]])
    x_m = np.linspace(0, STREET_M, count)
    frames = FrameTable(
        drive_id=np.array([f"drive{i % 4}" for i in range(count)]),
        camera=np.full(count, "CAM_FRONT"),
        timestamp_us=np.arange(count) * 500_000,
        path=np.array([f"{i}.jpg" for i in range(count)]),
        file_bytes=np.zeros(count, np.int64),
        width_px=np.full(count, 1600, np.int32),
        height_px=np.full(count, 900, np.int32),
        intrinsics=np.tile(np.array([[1266.0, 0, 800], [0, 1266, 450], [0, 0, 1]]), (count, 1, 1)),
        world_from_camera=np.stack([planar_transform(x, 0, 0) @ ego_from_camera for x in x_m]),
        is_keyframe=np.ones(count, np.bool_),
    )
    centres = np.linspace(0, STREET_M, bench.sub_field_count)
    sub_fields = tuple(SubField((x, 0.0, 1.6), (x - 40, -40.0, -5.0), (x + 40, 40.0, 20.0)) for x in centres.tolist())
    job = TileTraining("bench", frames, sub_fields, bench.settings, CHANNELS, threads=4, device=bench.device)
    run = CardRun(job, scratch, Noise(bench), np.arange(count), replays)
    if copies:
        run.field.use_copies(bench.dtype)
    return run


def graph_section(bench: Bench) -> Result:
    """A recorded step against the same step run kernel by kernel: the losses of some steps, one by one."""
    histories = []
    for replays in (False, True):
        with tempfile.TemporaryDirectory() as scratch:
            run = new_run(bench, Path(scratch), replays)
            # Step 0 again and again, then others: what is random must follow the step, not the number of the replay.
            steps = [0] * (EAGER_STEPS + 3) + list(range(1, 7)) if bench.on_card else [0, 1]
            histories.append([float(sum(run.advance(step).values())) for step in steps])
            run.close()
    eager, recorded = (np.array(history) for history in histories)
    error = float(np.abs(recorded / eager - 1).max())
    found = {"losses, eager": eager.tolist(), "losses, recorded": recorded.tolist(), "largest difference": error}
    # Sums of atomic additions differ in their last bits, and Adam's first steps magnify what is near zero.
    assert error < 0.05, f"{found}"
    return found


def step_section(bench: Bench, replays: bool, copies: bool) -> Result:
    """Whole steps past the warm-up, where the proposals learn in every fifth: time, rays a second and memory."""
    first, warm_up = bench.settings.training.steps // 2, 5 * (EAGER_STEPS + 2) if bench.on_card else 1
    with tempfile.TemporaryDirectory() as scratch:
        run = new_run(bench, Path(scratch), replays, copies)
        steps = iter(range(first, 2 * first))
        for _ in range(warm_up):
            run.advance(next(steps))
        timed = 50 if bench.on_card else 1
        # Ten steps at a time: two that train the proposals and eight that do not.
        group = 10 if bench.on_card else 1
        times = [bench.once(lambda: [run.advance(next(steps)) for _ in range(group)]) / group for _ in range(timed)]
        launched = time.perf_counter()
        run.advance(next(steps))
        launch_ms = (time.perf_counter() - launched) * 1000
        run.close()
    step_ms = statistics.median(times)
    found = {"step, ms": step_ms, "launch, ms": launch_ms, "slowest, ms": max(times)}
    found["rays per second"] = bench.settings.training.batch_rays / step_ms * 1000
    if bench.on_card:
        found["peak of tensors, GiB"] = torch.cuda.max_memory_allocated() / 2**30
        found["peak of the allocator, GiB"] = torch.cuda.max_memory_reserved() / 2**30
    return found


def profile_section(bench: Bench) -> Result:
    """Where a step's time goes: the kernels of five eager steps, milliseconds a step, the dearest first."""
    from torch.profiler import ProfilerActivity, profile

    activity = ProfilerActivity.CUDA if bench.on_card else ProfilerActivity.CPU
    with tempfile.TemporaryDirectory() as scratch:
        run = new_run(bench, Path(scratch), replays=False)
        first = bench.settings.training.steps // 2
        for step in range(first, first + 2):
            run.advance(step)
        with profile(activities=[activity]) as seen:
            for step in range(first, first + 5):
                run.advance(step)
            if bench.on_card:
                torch.cuda.synchronize()
        run.close()
    kind = "self_device_time_total" if bench.on_card else "self_cpu_time_total"
    events = sorted(seen.key_averages(), key=lambda event: getattr(event, kind), reverse=True)
    return {f"{event.key[:70]}, ms": getattr(event, kind) / 5000 for event in events[:30]}


def extraction_section(bench: Bench) -> Result:
    """Surface points of rays of an untrained field, in the networks' type of training and in float32."""
    count = 2**17 if bench.is_paper else 16
    found: Result = {}
    with tempfile.TemporaryDirectory() as scratch:
        run = new_run(bench, Path(scratch), replays=False)
        random = np.random.default_rng(0)
        origins = random.uniform((0, -2, 1), (STREET_M, 2, 2), (count, 3))
        directions = random.normal(size=(count, 3)) * (1, 1, 0.2)
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        for dtype in (bench.dtype, torch.float32):
            run.field.use_dtype(dtype)
            ms = bench.milliseconds(lambda: _surface(run.field, origins, directions), 3)
            found[f"{str(dtype).removeprefix('torch.')}, rays per second"] = count / ms * 1000
        run.close()
    return found


def _surface(field: TileField, origins: np.ndarray, directions: np.ndarray) -> None:
    find_surface(field, origins, directions, "first-hit")
