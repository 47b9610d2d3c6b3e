"""What feeding a tile of many images takes: `python bench/ray_feeding.py [--images 40000] [--step-ms 100]`.

A made-up source decodes a real JPEG of 1600 x 900 for every image it is asked for, and adds labels and features of
the paper's size; a step only sleeps. Prints the share of the time that steps waited for their batch, and the peak
memory of the process, which includes torch.
"""

import argparse
import json
import resource
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from presight_core.config import load_city_settings
from presight_core.drives import FrameTable
from presight_core.field import threads
from presight_core.frames import planar_transform
from presight_core.pixels import FramePixels, PixelSource
from stages.feeding import POOL_STEPS, Feed
from stages.tiling import sub_fields
from stages.training import TileTraining, training_rows

WIDTH_PX, HEIGHT_PX = 1600, 900
FEATURE_ROWS, FEATURE_COLUMNS, CHANNELS = 72, 128, 64  # DINO at stride 8 of 576 x 1024
STREET_M = 2000.0


class JpegSource(PixelSource):
    """The same street in every image, decoded anew."""

    def __init__(self) -> None:
        random = np.random.default_rng(0)
        coarse = random.integers(256, size=(45, 80, 3)).astype(np.uint8)
        image = cv2.resize(coarse, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_CUBIC)
        self._jpeg = cv2.imencode(".jpg", image)[1]
        self._labels = random.integers(11, size=(HEIGHT_PX // 2, WIDTH_PX // 2)).astype(np.uint8)
        self._features = random.integers(256, size=(FEATURE_ROWS, FEATURE_COLUMNS, CHANNELS)).astype(np.uint8)
        self.decoded = 0

    def load(self, row: int) -> FramePixels:
        """Any row."""
        self.decoded += 1
        rgb = cv2.cvtColor(cv2.imdecode(self._jpeg, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
        return FramePixels(rgb, self._labels.copy(), self._features.copy())


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--images", type=int, default=40_000)
    parser.add_argument("--steps", type=int, default=3 * POOL_STEPS)
    parser.add_argument("--step-ms", type=float, default=100.0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--set", action="append", default=[], help="a setting, section.name=value")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "out" / "ray_feeding.json")
    options = parser.parse_args()
    settings = load_city_settings(None, ["preset=paper", f"training.steps={options.steps}", *options.set])
    threads.keep_freed_memory()
    frames, source = street(options.images), JpegSource()
    job = TileTraining("bench", frames, sub_fields(frames.positions, settings.tiling), settings, CHANNELS)
    job = replace(job, threads=options.threads)
    started = time.perf_counter()
    with Feed(job, source, training_rows(frames, settings.training)) as feed:
        feed.batch(0)
        first_s, feed.waited_s = time.perf_counter() - started, 0.0
        started = time.perf_counter()
        for step in range(1, options.steps):
            feed.batch(step)
            time.sleep(options.step_ms / 1000)
    seconds = time.perf_counter() - started
    result = {
        "images": options.images,
        "batch_rays": settings.training.batch_rays,
        "first_batch_s": first_s,
        "steps_per_s": (options.steps - 1) / seconds,
        "waiting_share": feed.waited_s / seconds,
        "images_decoded": source.decoded,
        "peak_memory_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }
    for name, value in result.items():
        print(f"{name:20} {value:,.3f}" if isinstance(value, float) else f"{name:20} {value:,}")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


def street(count: int) -> FrameTable:
    """Cameras along a straight street."""
    ego_from_camera = np.array([[0, 0, 1, 1.5], [-1, 0, 0, 0], [0, -1, 0, 1.6], [0, 0, 0, 1]])
    poses = np.stack([planar_transform(x, 0, 0) for x in np.linspace(0, STREET_M, count)])
    return FrameTable(
        drive_id=np.array([f"drive{i // 240}" for i in range(count)]),
        camera=np.full(count, "CAM_FRONT"),
        timestamp_us=np.arange(count) * 83_333,
        path=np.array([f"samples/CAM_FRONT/{i:08}.jpg" for i in range(count)]),
        file_bytes=np.zeros(count, np.int64),
        width_px=np.full(count, WIDTH_PX, np.int32),
        height_px=np.full(count, HEIGHT_PX, np.int32),
        intrinsics=np.tile(np.array([[1266.0, 0, 800], [0, 1266, 450], [0, 0, 1]]), (count, 1, 1)),
        world_from_camera=poses @ ego_from_camera,
        is_keyframe=np.ones(count, np.bool_),
    )


if __name__ == "__main__":
    main()
