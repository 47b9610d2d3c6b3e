"""How true a field is: `python -m bench.field_quality WORKSPACE --tile 0 --set training.steps=2000 --at 500,1000`.

WORKSPACE is one that `presight demo` made: its features are used again, and one tile's field is trained with the
given settings. After the steps of `--at`, and at the end, held-out frames are compared with the embedded city's true
depth; at the end voxels are extracted and compared with its true surface. Minutes are processor minutes of training
alone. Prints a table, writes JSON and pictures to bench/out/field_quality/NAME.
"""

import argparse
import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree

from bench.field_tile import BenchTile, marks_of, open_tile, train
from bench.field_truth import NEAR_M, SceneTruth, SurfaceTruth, static_classes
from flows.demo import CITY
from presight_core import classes, pictures
from presight_core.cameras import pixel_centres
from presight_core.field import rendering, threads
from presight_core.field.lens import off_centre
from presight_core.field.tile_field import TileField
from presight_core.grid import Lattice
from presight_core.pixels import cell_of
from presight_core.priors.schema import CENTROID_STEPS, VoxelBatch, unpack_voxels
from stages.extraction import CameraHeights, chosen_rows, extract_tile
from stages.training import holdout_rows, lens_numbers, video_numbers

FAR_M = 50.0  # depths beyond are of no use to a prior
RAY_STRIDE = 8  # pixels between the rays of held-out frames: 1,400 an image
PICTURE_STRIDE = 3
PICTURE_ROWS = 6
CHUNK_RAYS = 8192
SEEN_M = 0.2  # edge of the cells by which seen surface is counted
DENSITIES = (0.25, 0.5, 1.0, 2.0)  # per metre: what remains of the voxels above each
WORST_ERROR = 0.3  # red in the picture


@dataclass(frozen=True)
class SeenTile(BenchTile):
    """A tile of an embedded city, and what its images show in truth."""

    truth: SceneTruth


@dataclass(frozen=True)
class Tile(SeenTile):
    """The same, and the whole surface, seen or not."""

    surface: SurfaceTruth


def main() -> None:
    """Train, compare, print, write."""
    options = _options()
    threads.use_threads(options.threads)
    threads.keep_freed_memory()
    opened = open_tile(options.workspace, CITY, options.tile, options.set, options.threads)
    drives, frames = opened.plan.drives, opened.job.frames
    truth = SceneTruth(drives, frames), SurfaceTruth(Path(drives[0].root), CITY)
    tile = Tile(opened.plan, opened.job, opened.extraction, opened.source, *truth)
    out = Path(__file__).parent / "out" / "field_quality" / options.name
    results: dict[str, Any] = {"settings": options.set, "curve": []}
    field = None
    for step, minutes, field in train(opened, marks_of(options.at)):
        figures = {"steps": step, "minutes": minutes, **held_out_figures(tile, field)}
        results["curve"].append(figures)
        print(json.dumps(rounded(figures)), flush=True)
    assert field is not None, "training always ends with a field"
    draw_held_out(tile, field, out / "held_out.png")
    if not options.no_voxels:
        results["voxels"] = voxel_figures(tile, field, out / "voxels.png")
        print(json.dumps(rounded(results["voxels"])), flush=True)
    (out / "results.json").write_text(json.dumps(rounded(results), indent=1) + "\n", encoding="utf-8")


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--tile", type=int, default=0)
    parser.add_argument("--name", default="default", help="folder of the results")
    parser.add_argument("--set", action="append", default=[], help="a setting, section.name=value")
    parser.add_argument("--at", default="", help="steps at which to look, besides the end")
    parser.add_argument("--no-voxels", action="store_true", help="judge depth and colours only")
    parser.add_argument("--threads", type=int, default=1)
    return parser.parse_args()


@dataclass(frozen=True)
class View:
    """What the field shows along rays."""

    distance_m: NDArray[np.float32]  # (R,) inf where it meets nothing
    rgb: NDArray[np.float32]
    features: NDArray[np.float32]


@torch.no_grad()
def render(tile: Tile, field: TileField, row: int, stride: int) -> View:
    """The field along the rays of every `stride`-th pixel of a frame, through its lens, in the light of its drive."""
    frames = tile.job.frames
    camera, video, lens = frames.camera_of(row), video_numbers(frames)[row], lens_numbers(frames)[row]
    pixels, size_px = (
        pixel_centres(camera.width_px, camera.height_px, stride),
        np.array([camera.width_px, camera.height_px]),
    )
    origin, directions = camera.rays(pixels)
    places = off_centre(pixels / size_px, size_px)
    parts = []
    for first in range(0, len(directions), CHUNK_RAYS):
        chunk = directions[first : first + CHUNK_RAYS]
        videos, lenses = (np.full(len(chunk), number) for number in (video, lens))
        through = lenses, places[first : first + CHUNK_RAYS]
        seen = field(field.rays(np.broadcast_to(origin, chunk.shape), chunk, videos, None, *through))
        depth_m, found = rendering.first_hit_depth(seen.field.weights, seen.edges_m)
        parts.append((torch.where(found, depth_m, torch.inf), seen.rgb.clamp(0, 1), seen.features.clamp(0, 1)))
    return View(*(torch.cat(values).float().numpy() for values in zip(*parts, strict=True)))


def held_out_figures(tile: Tile, field: TileField) -> dict[str, Any]:
    """Depth errors relative to the true depth, PSNR and cosine of centred features, over all held-out frames."""
    errors, labels, squares, shown, wanted = [], [], [], [], []
    for row in holdout_rows(tile.job.frames, tile.job.settings.training).tolist():
        true = tile.truth.rays(row, RAY_STRIDE)
        view, (rgb, features) = render(tile, field, row, RAY_STRIDE), pixels_of(tile, row, RAY_STRIDE)
        near = static_classes()[true.labels] & (true.distance_m < FAR_M)
        errors.append(np.abs(view.distance_m[near] / true.distance_m[near] - 1))
        labels.append(true.labels[near])
        static = static_classes()[true.labels] | (true.labels == classes.SKY)
        squares.append(np.mean((view.rgb[static] - rgb[static]) ** 2))
        shown.append(view.features[near])
        wanted.append(features[near])
    error, label = np.concatenate(errors), np.concatenate(labels)
    truth = np.concatenate(wanted)
    middle = truth.mean(0)
    by_class = {
        classes.CITYSCAPES[number]: [float(np.median(error[label == number])), int((label == number).sum())]
        for number in np.unique(label).tolist()
    }
    return {
        "depth_error": float(np.median(error)),
        "within_10_percent": float((error < 0.1).mean()),
        "psnr_db": float(np.mean(-10 * np.log10(squares))),
        "feature_cosine": float(np.median(cosine(np.concatenate(shown) - middle, truth - middle))),
        "by_class": by_class,
    }


def pixels_of(tile: BenchTile, row: int, stride: int) -> tuple[NDArray, NDArray]:
    """Colours (N, 3) and features (N, C), 0..1, of every `stride`-th pixel of a row's image."""
    image, camera = tile.source.load(row), tile.job.frames.camera_of(row)
    pixels = pixel_centres(camera.width_px, camera.height_px, stride)
    size_px = camera.width_px, camera.height_px
    rgb, features = (grid[cell_of(pixels, size_px, grid.shape)] for grid in (image.rgb, image.features))
    return rgb / np.float32(255), features / np.float32(255)


def cosine(a: NDArray, b: NDArray) -> NDArray:
    """Cosines (N,) between rows."""
    return (a * b).sum(-1) / np.maximum(np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1), 1e-9)


def draw_held_out(tile: Tile, field: TileField, file: Path) -> None:
    """Six held-out frames: image, true depth, the field's depth, its error."""
    rows = holdout_rows(tile.job.frames, tile.job.settings.training)
    strips = []
    for row in rows[np.linspace(0, len(rows) - 1, PICTURE_ROWS).astype(int)].tolist():
        true = tile.truth.rays(row, PICTURE_STRIDE)
        view = render(tile, field, row, PICTURE_STRIDE)
        camera = tile.job.frames.camera_of(row)
        shape = len(range(PICTURE_STRIDE // 2, camera.height_px, PICTURE_STRIDE)), -1
        with np.errstate(invalid="ignore"):  # sky in both
            error = np.abs(view.distance_m / true.distance_m - 1)
        known = static_classes()[true.labels] & (true.distance_m < FAR_M)
        rgb, _ = pixels_of(tile, row, PICTURE_STRIDE)
        strips.append(
            [
                np.round(rgb * 255).astype(np.uint8).reshape(*shape, 3),
                pictures.depth_image(true.distance_m.reshape(shape)),
                np.round(view.rgb * 255).astype(np.uint8).reshape(*shape, 3),
                pictures.depth_image(view.distance_m.reshape(shape)),
                error_image(np.where(known, error, np.nan)).reshape(*shape, 3),
            ]
        )
    titles = ("image", "true depth", "rendered", "depth", "error, 0 to 30 %")
    pictures.save_png(file, pictures.stack_rows(strips, titles, 225))


def error_image(error: NDArray) -> pictures.Rgb:
    """Errors (N,) from green (0) to red; black where there is none to tell."""
    from matplotlib import colormaps

    colours = colormaps["RdYlGn_r"](np.clip(np.nan_to_num(error, posinf=1) / WORST_ERROR, 0, 1), bytes=True)[:, :3]
    return np.where(np.isnan(error)[:, None], 0, colours).astype(np.uint8)


def voxel_figures(tile: Tile, field: TileField, picture: Path) -> dict[str, Any]:
    """Precision, recall and F-score of the voxels at 0.4 m, also of the dense alone, beside those of true depth."""
    started = time.process_time()
    with tempfile.TemporaryDirectory() as scratch:
        result = extract_tile(tile.extraction, field, tile.source, Path(scratch))
        batches = list(result.batches)
    points, density = (np.concatenate(part) for part in zip(*((centroids(b), b.density) for b in batches), strict=True))
    minutes = (time.process_time() - started) / 60
    seen, labels = seen_surface(tile)
    distance_m = tile.surface.distance_m(points)
    draw_voxels(points, distance_m, picture)
    figures = {"voxels": len(points), "extraction_minutes": minutes, "counts": result.counts}
    figures |= scores(points, distance_m, seen, labels)
    figures["denser_than"] = {
        least: {"voxels": int(dense.sum()), **scores(points[dense], distance_m[dense], seen, labels)}
        for least in DENSITIES
        for dense in (density > least,)
    }
    best, hits = true_voxels(tile)
    best_m = tile.surface.distance_m(best)
    figures["ceiling_of_hits"] = {
        least: scores(best[hits >= least], best_m[hits >= least], seen, labels) for least in (1, 2)
    }
    return figures


def scores(points: NDArray, distance_m: NDArray, seen: NDArray, labels: NDArray) -> dict[str, Any]:
    """Precision of points (N, 3) with these distances to the surface, recall of seen surface (M, 3), and F-score."""
    found = KDTree(points).query(seen, distance_upper_bound=NEAR_M)[0] < NEAR_M
    precision, recall = float((distance_m < NEAR_M).mean()), float(found.mean())
    by_class = {
        classes.CITYSCAPES[number]: float(found[labels == number].mean()) for number in np.unique(labels).tolist()
    }
    return {
        "precision": precision,
        "precision_half_voxel": float((distance_m < NEAR_M / 2).mean()),
        "recall": recall,
        "f_score": 2 * precision * recall / (precision + recall),
        "recall_by_class": by_class,
    }


def centroids(batch: VoxelBatch) -> NDArray[np.float64]:
    """World centroids (N, 3) of a batch's voxels."""
    lattice = Lattice()
    blocks = np.repeat(batch.block_index, np.diff(batch.block_start), axis=0)
    voxels = unpack_voxels(batch.voxel, blocks, lattice)
    return lattice.voxel_min(voxels) + (batch.centroid + 0.5) / CENTROID_STEPS * lattice.voxel_m


@dataclass(frozen=True)
class TrueHits:
    """Where pixels of one image meet a static surface that extraction would keep."""

    pixels: NDArray[np.int64]  # (N,) among every so many-th of the image
    points_world: NDArray[np.float64]  # (N, 3)
    labels: NDArray[np.uint8]  # (N,)


def true_hits(tile: SeenTile, row: int, stride: int, heights: CameraHeights) -> TrueHits:
    """Of every `stride`-th pixel of a row's image."""
    settings, true = tile.job.settings.extraction, tile.truth.rays(row, stride)
    kept = np.flatnonzero(static_classes()[true.labels] & (true.distance_m < settings.max_depth_m))
    met = tile.job.frames.positions[row] + true.distance_m[kept, None] * true.directions[kept]
    above_m = met[:, 2] - heights.at(met)
    inside = (above_m >= -settings.below_camera_m) & (above_m <= settings.above_camera_m)
    inside &= tile.extraction.owned(Lattice().block_of(Lattice().voxel_of(met)))
    return TrueHits(kept[inside], met[inside], true.labels[kept[inside]])


def true_points(tile: Tile, rows: list[int], stride: int) -> tuple[NDArray, NDArray]:
    """Static surface points (N, 3) that rays of these rows meet where extraction would keep them, and labels."""
    heights = CameraHeights(tile.job.frames.positions)
    hits = [true_hits(tile, row, stride, heights) for row in rows]
    return np.concatenate([each.points_world for each in hits]), np.concatenate([each.labels for each in hits])


def seen_surface(tile: Tile) -> tuple[NDArray, NDArray]:
    """One point for each cell of SEEN_M that any pixel of the extraction's frames sees, and its label."""
    points, labels = true_points(tile, chosen_rows(tile.extraction), 1)
    _, first = np.unique(np.floor(points / SEEN_M).astype(np.int32), axis=0, return_index=True)
    return points[first], labels[first]


def true_voxels(tile: Tile) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Centroids (N, 3) and hits (N,) of the voxels that extraction's rays would meet if the field's depth were true."""
    settings = tile.job.settings.extraction
    points, _ = true_points(tile, chosen_rows(tile.extraction), settings.pixel_stride)
    _, inverse, hits = np.unique(Lattice().voxel_of(points), axis=0, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(inverse.ravel(), axis) for axis in points.T], -1)
    return sums / hits[:, None], hits


def draw_voxels(points: NDArray, distance_m: NDArray, file: Path) -> None:
    """The voxels from above, by their distance to the surface."""
    low = points.min(0)[:2]
    columns = ((points[:, :2] - low) / 0.4).astype(np.int64)
    worst = np.zeros(columns.max(0) + 1)
    np.maximum.at(worst, tuple(columns.T), np.minimum(distance_m, 1.0))
    seen = np.zeros(worst.shape, np.bool_)
    seen[tuple(columns.T)] = True
    image = error_image(np.where(seen, worst * WORST_ERROR, np.nan).ravel()).reshape(*worst.shape, 3)
    pictures.save_png(file, np.kron(image.transpose(1, 0, 2)[::-1], np.ones((3, 3, 1), np.uint8)))


def rounded(value: Any) -> Any:
    """Nested results with four digits."""
    if isinstance(value, dict):
        return {name: rounded(part) for name, part in value.items()}
    if isinstance(value, list):
        return [rounded(part) for part in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value


if __name__ == "__main__":
    main()
