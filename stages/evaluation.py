"""Evaluation: how well a tile's field shows frames that it was not trained on."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from presight_core import classes, pictures
from presight_core.field import rendering
from presight_core.field.tile_field import TileField
from presight_core.pixels import PixelSource
from presight_core.progress import Progress, Report, silent
from stages.ray_pool import PixelBatch, RayPool
from stages.training import TileTraining, holdout_rows, lens_numbers, video_numbers

METRIC_PIXELS = 40_000  # of all held-out images together: PSNR then varies by less than 0.1 dB between draws
MIN_PIXELS = 200  # of an image, however many there are
MAX_IMAGES = 200  # evenly spread; more would only cost time
PICTURE_PIXELS = 30_000  # of an image in the picture
PICTURE_ROWS = 3
CHUNK_RAYS = 8192
_Numbers = tuple[NDArray[np.int64], NDArray[np.int64]]  # of all frames' lenses and videos
COLUMNS = ("real", "rendered", "depth", "real feature", "rendered feature")


@dataclass(frozen=True)
class Evaluation:
    """Figures of a tile's held-out frames; empty where none are held out."""

    metrics: dict[str, float]  # means over images
    drive_psnr_db: dict[str, float]  # mean psnr_own_video_db of each drive's images, by drive id


def evaluate_tile(
    job: TileTraining, field: TileField, source: PixelSource, pictures_folder: Path, report: Report = silent
) -> Evaluation:
    """Figures of the held-out frames, and `rows.png` with three of them.

    psnr_db is the mean over images, over pixels that show nothing dynamic, at the mean of all embeddings;
    psnr_own_video_db uses the embedding of the image's own drive. feature_rmse is in units of the feature
    space. found_share is the share of pixels below the sky at which a surface is met, sky_share that of
    the sky's at which none is. Raises InputError if an image cannot be read.
    """
    rows = _spread(holdout_rows(job.frames, job.settings.training), MAX_IMAGES)
    shown = set(_spread(rows, PICTURE_ROWS).tolist())
    numbers = lens_numbers(job.frames), video_numbers(job.frames)
    table, picture_rows = [], []
    for done, row in enumerate(rows.tolist()):
        report(Progress("evaluation", done, len(rows)))
        pool = RayPool(job.frames, source, np.array([row]))
        table.append(_figures(job, field, pool, numbers, max(MIN_PIXELS, METRIC_PIXELS // len(rows))))
        if row in shown:
            picture_rows.append(_picture_row(field, pool, numbers))
    if picture_rows:
        pictures_folder.mkdir(parents=True, exist_ok=True)
        pictures.save_png(pictures_folder / "rows.png", pictures.stack_rows(picture_rows, COLUMNS))
    report(Progress("evaluation", len(rows), len(rows)))
    psnr_db: dict[str, list[float]] = {}
    for drive_id, figures in zip(job.frames.drive_id[rows].tolist(), table, strict=True):
        if "psnr_own_video_db" in figures:
            psnr_db.setdefault(drive_id, []).append(figures["psnr_own_video_db"])
    names = sorted({name for figures in table for name in figures})
    return Evaluation(
        {name: float(np.mean([figures[name] for figures in table if name in figures])) for name in names},
        {drive_id: float(np.mean(values)) for drive_id, values in psnr_db.items()},
    )


@dataclass(frozen=True)
class _View:
    """What rays see, as numpy arrays."""

    rgb: NDArray[np.float32]  # (R, 3)
    features: NDArray[np.float32]  # (R, C)
    depth_m: NDArray[np.float32]  # (R,) 0 where the ray meets nothing

    @property
    def found(self) -> NDArray[np.bool_]:
        return self.depth_m > 0


@torch.no_grad()
def _render(
    field: TileField, batch: PixelBatch, lenses: NDArray[np.int64], videos: NDArray[np.int64] | None = None
) -> _View:
    """What the field shows through each ray's lens (R,); the mean of all videos unless they are given."""
    parts = []
    for first in range(0, len(batch.rows), CHUNK_RAYS):
        chunk = slice(first, first + CHUNK_RAYS)
        chosen = None if videos is None else videos[chunk]
        through = lenses[chunk], batch.off_centre[chunk]
        seen = field(field.rays(batch.origins_world[chunk], batch.directions_world[chunk], chosen, None, *through))
        depth_m, found = rendering.first_hit_depth(seen.field.weights, seen.edges_m)
        parts.append((seen.rgb.clamp(0, 1), seen.features.clamp(0, 1), depth_m * found))
    rgb, features, depth_m = (torch.cat(values).float().cpu().numpy() for values in zip(*parts, strict=True))
    return _View(rgb, features, depth_m)


def _figures(
    job: TileTraining, field: TileField, pool: RayPool, numbers: _Numbers, pixel_count: int
) -> dict[str, float]:
    """Figures of one image, from random pixels of it; those without any pixel to speak of are left out."""
    random = np.random.default_rng([job.settings.training.seed, int(pool.rows[0])])
    batch = pool.draw(pixel_count, [np.array([0])], random)
    batch = batch.select(~classes.lookup(job.settings.features.dynamic_classes)[batch.labels])
    if not len(batch.rows):
        return {}
    lenses, videos = (each[batch.rows] for each in numbers)
    view = _render(field, batch, lenses)
    figures = {
        "psnr_db": _psnr_db(view, batch),
        "psnr_own_video_db": _psnr_db(_render(field, batch, lenses, videos), batch),
        "feature_rmse": float(np.sqrt(np.mean((view.features - batch.features / np.float32(255)) ** 2))),
    }
    is_sky, known = batch.labels == classes.SKY, batch.labels != classes.UNKNOWN
    for name, mask, right in (("found_share", ~is_sky & known, view.found), ("sky_share", is_sky, ~view.found)):
        if mask.any():
            figures[name] = float(right[mask].mean())
    return figures


def _psnr_db(view: _View, batch: PixelBatch) -> float:
    error = float(np.mean((view.rgb - batch.rgb / np.float32(255)) ** 2))
    return -10 * float(np.log10(max(error, 1e-10)))  # 100 dB at most


def _picture_row(field: TileField, pool: RayPool, numbers: _Numbers) -> list[pictures.Rgb]:
    """The image, its rendering with the embedding of its own drive, depth, features and rendered features."""
    width, height = pool.size_px(0)
    stride = max(1, round((width * height / PICTURE_PIXELS) ** 0.5))
    columns, rows = np.arange(stride // 2, width, stride), np.arange(stride // 2, height, stride)
    pixels = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
    batch = pool.at(np.zeros(len(pixels), np.int64), pixels)
    view = _render(field, batch, *(each[batch.rows] for each in numbers))
    shape = len(rows), len(columns), -1
    return [
        batch.rgb.reshape(shape),
        np.round(view.rgb.reshape(shape) * 255).astype(np.uint8),
        pictures.depth_image(view.depth_m.reshape(shape[:2])),
        pictures.feature_image(batch.features.reshape(shape)),
        pictures.feature_image(view.features.reshape(shape)),
    ]


def _spread(rows: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """At most `count` of the rows, evenly spread."""
    if len(rows) <= count:
        return rows
    return rows[((np.arange(count) + 0.5) * len(rows) / count).astype(np.int64)]
