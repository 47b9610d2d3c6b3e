"""How right the depths are that neighbouring images tell: `python -m bench.stereo WORKSPACE [--tile 0]`.

WORKSPACE is one that `presight demo` made. All training frames of a tile are compared at their own width; depths of
static pixels are then held against the embedded city's true ones. Prints a table, writes JSON and a picture to
bench/out/stereo.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.field_tile import BenchTile, open_tile
from bench.field_truth import SceneTruth, static_classes
from flows.demo import CITY
from presight_core import classes, pictures
from presight_core.field import threads
from presight_core.plane_sweep import CELL_PX, grid_shape
from stages.stereo import Images, depth_maps
from stages.training import training_rows

RIGHT = 0.05, 0.1  # shares of the depth
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
    _found(tile, rows[:2])  # compiles
    started = time.process_time()
    found_m = _found(tile, rows)
    seconds = (time.process_time() - started) / len(rows)
    true_m, labels = _truth(tile, rows)
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


def _found(tile: BenchTile, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Depths (images, rows, columns), metres; 0 where nothing is known."""
    frames = tile.job.frames
    with tempfile.TemporaryDirectory() as folder:
        images = Images(frames, rows, tile.source)
        maps = depth_maps(images, int(frames.width_px.max()), Path(folder) / "depths.npy")
        return maps.astype(np.float64)


def _truth(tile: BenchTile, rows: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """True depths and labels of the same cells."""
    frames, scene = tile.job.frames, SceneTruth(tile.plan.drives, tile.job.frames)
    depths_m, labels = [], []
    for row in rows.tolist():
        true, camera = scene.rays(row, CELL_PX), frames.camera_of(row)
        shape = grid_shape(camera.width_px, camera.height_px)
        depths_m.append((true.distance_m * (true.directions @ camera.world_from_camera[:3, 2])).reshape(shape))
        labels.append(true.labels.reshape(shape))
    return np.stack(depths_m), np.stack(labels)


def _shares(found_m: NDArray, true_m: NDArray, labels: NDArray[np.uint8]) -> dict[str, Any]:
    """Figures of all static cells, and of each class."""
    static = static_classes()[labels]
    parts = {"all": static} | {
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
        rgb = tile.source.load(int(rows[image])).rgb[CELL_PX // 2 :: CELL_PX, CELL_PX // 2 :: CELL_PX]
        depths = (np.where(depth_m > 0, depth_m, np.inf) for depth_m in (found_m[image], true_m[image]))
        strips.append([rgb, *(pictures.depth_image(depth_m) for depth_m in depths)])
    pictures.save_png(file, pictures.stack_rows(strips, ("image", "known depth", "true depth"), 225))


if __name__ == "__main__":
    main()
