"""Whether half-precision networks cost quality: `python bench/precision.py [--steps 400]`.

A street whose colours are known by formula is learned twice, with networks in float32 and in bfloat16, and from the
same random numbers; prints the PSNR of rays that were not trained on. Where the processor does not multiply bfloat16
the second one is slow; its result is that of processors which do.
"""

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from train_step import street

from presight_core import classes
from presight_core.config import load_city_settings
from presight_core.field import threads
from stages.ray_pool import PixelBatch
from stages.tiling import sub_fields
from stages.training import Run, TileTraining, training_rows

CHANNELS = 8
HELD_OUT_RAYS = 8192


def main() -> None:
    """Train, compare, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--rays", type=int, default=512)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "out" / "precision.json")
    options = parser.parse_args()
    threads.use_threads(1)
    threads.keep_freed_memory()
    results = []
    for seed in range(options.seeds):
        for dtype in (torch.float32, torch.bfloat16):
            psnr_db = trained_psnr_db(options, seed, dtype)
            results.append({"seed": seed, "type": str(dtype), "psnr_db": psnr_db})
            print(f"seed {seed}  {dtype!s:16} {psnr_db:.2f} dB", flush=True)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")


def trained_psnr_db(options: argparse.Namespace, seed: int, dtype: torch.dtype) -> float:
    """Held-out PSNR after training with networks of one type."""
    sizes = (f"training.steps={options.steps}", f"training.batch_rays={options.rays}", f"training.seed={seed}")
    settings = load_city_settings(None, ["preset=demo", "training.bfloat16=false", *sizes])
    frames = street()
    job = TileTraining("bench", frames, sub_fields(frames.positions, settings.tiling), settings, CHANNELS)
    with tempfile.TemporaryDirectory() as scratch:
        run = Run(job, Path(scratch))
        run.field.use_dtype(dtype)
        for step in range(options.steps):
            run.train(step, batch(job, options.rays, (seed, step)))
        held_out = batch(job, HELD_OUT_RAYS, (seed, options.steps))
        with torch.no_grad():
            seen = run.field(run.field.rays(held_out.origins_world, held_out.directions_world))
    error = np.mean((seen.rgb.float().numpy() - held_out.rgb / np.float32(255)) ** 2)
    return -10 * float(np.log10(error))


def batch(job: TileTraining, count: int, seed: tuple[int, int]) -> PixelBatch:
    """Rays of random frames, and what they see."""
    random = np.random.default_rng(seed)
    rows = random.choice(training_rows(job.frames, job.settings.training), count)
    directions = random.normal(size=(count, 3)) * (1, 1, 0.3) - (0, 0, 0.1)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    rgb, labels = seen_by(job.frames.positions[rows], directions)
    features = np.repeat(rgb[:, :1], CHANNELS, 1)
    return PixelBatch(rows, job.frames.positions[rows], directions, np.zeros(count), rgb, labels, features)


def seen_by(origins: NDArray[np.float64], directions: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
    """Colours (R, 3) and labels (R,): a chequered road between striped walls 10 m away and 6 m high, below the sky."""
    with np.errstate(divide="ignore"):
        ground_m = np.where(directions[:, 2] < 0, -origins[:, 2] / directions[:, 2], np.inf)
        wall_m = 10 / np.abs(directions[:, 1])
    depth_m = np.minimum(ground_m, wall_m)
    points = origins + depth_m[:, None] * directions
    is_sky = points[:, 2] > 6
    stripes = 0.5 + 0.4 * np.sin(points[:, [0]] * (1.0, 1.7, 2.3)) * np.cos(points[:, [2]])
    chequers = np.where((np.floor(points[:, 0] / 2) + np.floor(points[:, 1] / 2)) % 2, 0.3, 0.6)[:, None]
    colours = np.where((wall_m < ground_m)[:, None], stripes, chequers)
    colours = np.where(is_sky[:, None], (0.5, 0.7, 0.9), colours)
    labels = np.where(is_sky, classes.SKY, 0).astype(np.uint8)
    return np.round(colours * 255).astype(np.uint8), labels


if __name__ == "__main__":
    main()
