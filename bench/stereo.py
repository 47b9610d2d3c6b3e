"""How right the depths are that neighbouring images tell: `python -m bench.stereo WORKSPACE [--tile 0]`.

WORKSPACE is one that `presight demo` made. All training frames of a tile are compared at their own width; what a
training is then told of static pixels is held against the embedded city's true depths. Prints a table, writes JSON and
a picture to bench/out/stereo.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from bench.field_tile import BenchTile, open_tile
from bench.field_truth import SceneTruth, static_classes
from flows.demo import CITY
from presight_core import classes, pictures
from presight_core.cameras import pixel_centres
from presight_core.field import threads
from presight_core.field.rays import Rays
from presight_core.pixels import cell_of
from stages.stereo import Images, KnownDepths, plane_maps
from stages.training import training_rows

RIGHT = 0.02, 0.05, 0.1  # shares of the depth
STRIDE_PX = 3  # between the pixels that are looked at: all parts of a cell, which is four wide
PICTURE_ROWS = 6


def main() -> None:
    """Compare, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--tile", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    threads.use_threads(options.threads)
    tile = open_tile(options.workspace, CITY, options.tile, [], options.threads)
    rows = training_rows(tile.job.frames, tile.job.settings.training)
    _known(tile, rows[:2])  # compiles
    started = time.process_time()
    known = _known(tile, rows)
    seconds = (time.process_time() - started) / len(rows)
    found_m, true_m, labels = _told(tile, rows, known)
    results = {"images": len(rows), "processor_s_an_image": seconds, "of": _shares(found_m, true_m, labels)}
    print(f"{len(rows)} images, {seconds:.2f} processor seconds each\n")
    print("| | known | " + " | ".join(f"of these within {share:.0%}" for share in RIGHT) + " | median error |")
    print("|---" * (len(RIGHT) + 3) + "|")
    for name, figures in results["of"].items():
        print(f"| {name} | " + " | ".join(f"{figure:.1%}" for figure in figures.values()) + " |")
    out = Path(__file__).parent / "out" / "stereo"
    out.mkdir(parents=True, exist_ok=True)
    (out / "results.json").write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    _draw(tile, rows, found_m, true_m, out / "depths.png")


def _known(tile: BenchTile, rows: NDArray[np.int64]) -> KnownDepths:
    frames = tile.job.frames
    width_px = int(frames.width_px.max())
    with tempfile.TemporaryDirectory() as folder:
        maps = np.array(plane_maps(Images(frames, rows, tile.source), width_px, Path(folder) / "planes.npy"))
    return KnownDepths(maps, frames.select(rows), width_px, "cpu")


def _told(tile: BenchTile, rows: NDArray[np.int64], known: KnownDepths) -> tuple[NDArray, NDArray, NDArray[np.uint8]]:
    """Distances (images, rows, columns) along pixels' rays, metres, 0 where nothing is known; the true; true labels."""
    frames, scene = tile.job.frames, SceneTruth(tile.plan.drives, tile.job.frames)
    found_m, true_m, labels = [], [], []
    for image, row in enumerate(rows.tolist()):
        true, camera = scene.rays(row, STRIDE_PX), frames.camera_of(row)
        size_px = camera.width_px, camera.height_px
        pixels = pixel_centres(*size_px, STRIDE_PX)
        _, seen = tile.source.load_view(row)
        directions = torch.from_numpy(true.directions.astype(np.float32))
        rays = Rays(torch.zeros_like(directions), directions, None, torch.full((len(directions),), image))
        ends_m = known.along(rays, torch.from_numpy(seen[cell_of(pixels, size_px, seen.shape)]))[:, 0]
        shape = len(range(STRIDE_PX // 2, camera.height_px, STRIDE_PX)), -1
        found_m.append(ends_m.numpy().reshape(shape))
        true_m.append(true.distance_m.reshape(shape))
        labels.append(true.labels.reshape(shape))
    return np.stack(found_m), np.stack(true_m), np.stack(labels)


def _shares(found_m: NDArray, true_m: NDArray, labels: NDArray[np.uint8]) -> dict[str, Any]:
    """Figures of all static cells, and of each class."""
    static = static_classes()[labels]
    parts = {"all": static, "30 to 50 m": static & (true_m >= 30) & (true_m < 50)} | {
        classes.CITYSCAPES[number]: labels == number for number in np.unique(labels[static]).tolist()
    }
    figures = {}
    for name, chosen in parts.items():
        known = chosen & (found_m > 0)
        error = np.abs(found_m[known] / true_m[known] - 1)
        within = {f"within_{share}": float((error < share).mean()) for share in RIGHT}
        figures[name] = {"known": float(known.sum() / chosen.sum()), **within, "median": float(np.median(error))}
    return figures


def _draw(tile: BenchTile, rows: NDArray[np.int64], found_m: NDArray, true_m: NDArray, file: Path) -> None:
    """Some images, what is known of them, and the truth."""
    strips = []
    for image in np.linspace(0, len(rows) - 1, PICTURE_ROWS).astype(int).tolist():
        rgb, _ = tile.source.load_view(int(rows[image]))
        rgb = rgb[STRIDE_PX // 2 :: STRIDE_PX, STRIDE_PX // 2 :: STRIDE_PX]
        depths = (np.where(depth_m > 0, depth_m, np.inf) for depth_m in (found_m[image], true_m[image]))
        strips.append([rgb, *(pictures.depth_image(depth_m) for depth_m in depths)])
    pictures.save_png(file, pictures.stack_rows(strips, ("image", "known depth", "true depth"), 225))


if __name__ == "__main__":
    main()
