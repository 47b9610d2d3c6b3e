"""A trained field becomes voxels: where the tile's training rays meet a surface, and what the field says there."""

import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from presight_core import classes
from presight_core.cameras import pixel_centres
from presight_core.config import CitySettings
from presight_core.drives import FrameTable
from presight_core.errors import InputError
from presight_core.field.surface import SurfacePoints, find_surface
from presight_core.field.tile_field import TileField
from presight_core.grid import Lattice, morton
from presight_core.pixels import PixelSource, cell_of
from presight_core.priors.schema import VoxelBatch
from presight_core.progress import Progress, Report, silent
from presight_core.tiles import Tiling
from stages.camera_heights import CameraHeights
from stages.observed_columns import ObservedColumns
from stages.training import holdout_mask
from stages.voxel_sums import CELLS, SUPERBLOCK, Samples, Superblock, VoxelSums

RAYS_TOGETHER = 24_000  # are followed at a time, at least: fewer take longer, each


@dataclass(frozen=True)
class TileExtraction:
    """What to extract: a tile of a tiling on the city's lattice, from the frames that it was trained on."""

    tile: int  # index into tiling.tiles
    tiling: Tiling
    lattice: Lattice
    frames: FrameTable
    settings: CitySettings
    feature_channels: int

    @cached_property
    def drives(self) -> tuple[str, ...]:
        """The drives of the frames, sorted: the order of the drive bits."""
        return tuple(sorted(set(self.frames.drive_id.tolist())))

    def owned(self, blocks: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Which lattice blocks (N, 2) belong to the tile."""
        _, index, inverse = np.unique(morton(blocks), return_index=True, return_inverse=True)
        return (self.tiling.owner_of(blocks[index], self.lattice) == self.tile)[inverse]


@dataclass(frozen=True)
class ExtractionResult:
    """The tile's voxels. `counts` tells how many pixels, points and voxels each filter took."""

    batches: Iterator[VoxelBatch]  # a superblock each, in Morton order; read from the scratch folder
    drives: tuple[str, ...]  # in bit order
    counts: dict[str, int]


@dataclass(frozen=True)
class Rays:
    """The rays of one frame that are worth following."""

    origin: NDArray[np.float64]  # (3,) world
    directions: NDArray[np.float64]  # (N, 3) world, unit
    features: NDArray[np.uint8]  # (N, C) of the image where each ray leaves it, 255 = 1.0


def extract_tile(
    job: TileExtraction, field: TileField, source: PixelSource, scratch: Path, report: Report = silent
) -> ExtractionResult:
    """The voxels of a tile, averaged over the surface points of its training rays.

    `scratch` must stay until the batches are read; what an earlier run left there is removed. Raises
    InputError if an image cannot be read or the field has another number of feature channels.
    """
    folder = scratch / "voxels"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    settings = job.settings.extraction
    sums = VoxelSums(job.lattice, job.feature_channels, len(job.drives), folder)
    columns = ObservedColumns(job.lattice, settings.max_depth_m)
    heights = CameraHeights(job.frames.positions)
    counts: Counter[str] = Counter()
    rows = chosen_rows(job)
    followed = _followed(job, field, rows, source, counts)
    for done, (row, met, middles) in enumerate(followed, 1):
        rays, surface = _both_ends(job.lattice, met, middles)
        kept = _filtered(job, surface, heights, counts)
        columns.add(rays.origin, _seen_ends(job, rays, surface, kept, heights))
        samples = Samples(surface.points_world, surface.features, surface.rgb, surface.density).select(kept)
        sums.add(samples, job.drives.index(str(job.frames.drive_id[row])))
        report(Progress("extraction", done, len(rows), {"points": counts["points"]}))
    columns.keep(job.owned)
    counts["voxels"], counts["few_hits"] = sums.finish(settings.min_hits)
    return ExtractionResult(voxel_batches(sums, columns), job.drives, dict(counts))


def chosen_rows(job: TileExtraction) -> list[int]:
    """Rows of the frames to follow: every n-th training frame of each camera of each drive.

    Neighbours in space follow each other, so that the sums of a place meet while they are in memory.
    """
    frames, settings = job.frames, job.settings
    trained = np.flatnonzero(~holdout_mask(frames, settings.training.holdout_every))
    by_time = trained[np.lexsort([frames.timestamp_us[trained], frames.camera[trained], frames.drive_id[trained]])]
    names = np.char.add(np.char.add(frames.drive_id, "\n"), frames.camera)[by_time]
    _, starts, inverse = np.unique(names, return_index=True, return_inverse=True)
    place_in_drive = np.arange(len(by_time)) - starts[inverse]
    rows = np.sort(by_time[place_in_drive % settings.extraction.frame_stride == 0])
    blocks = job.lattice.block_of(job.lattice.voxel_of(frames.positions[rows]))
    return rows[np.argsort(morton(blocks), kind="stable")].tolist()


def _rays(job: TileExtraction, row: int, source: PixelSource, counts: Counter[str]) -> Rays:
    """Rays of one frame through every n-th pixel, but for dynamic things and the sky."""
    camera = job.frames.camera_of(row)
    pixels = pixel_centres(camera.width_px, camera.height_px, job.settings.extraction.pixel_stride)
    image, size_px = source.load(row), (camera.width_px, camera.height_px)
    labels = image.labels[cell_of(pixels, size_px, image.labels.shape)]
    dynamic = classes.lookup(job.settings.features.dynamic_classes)[labels]
    sky = (labels == classes.SKY) & ~dynamic
    counts.update(pixels=len(pixels), dynamic=int(dynamic.sum()), sky=int(sky.sum()))
    followed = pixels[~dynamic & ~sky]
    return Rays(*camera.rays(followed), image.features[cell_of(followed, size_px, image.features.shape)])


def _followed(
    job: TileExtraction, field: TileField, rows: list[int], source: PixelSource, counts: Counter[str]
) -> Iterator[tuple[int, Rays, SurfacePoints]]:
    """Each row with its rays that meet a surface, and those surfaces. The field is asked for some rows at a time."""
    waiting: list[tuple[int, Rays]] = []
    for row in rows:
        waiting.append((row, _rays(job, row, source, counts)))
        if sum(len(rays.directions) for _, rays in waiting) >= RAYS_TOGETHER or row == rows[-1]:
            for (each, rays), surface in zip(
                waiting, _surfaces(job, field, [rays for _, rays in waiting]), strict=True
            ):
                yield each, *_found(job, rays, surface, counts)
            waiting.clear()


def _surfaces(job: TileExtraction, field: TileField, frames: list[Rays]) -> Iterator[SurfacePoints]:
    """What the rays of each frame meet."""
    settings = job.settings.extraction
    origins = np.concatenate([np.broadcast_to(rays.origin, rays.directions.shape) for rays in frames])
    directions = np.concatenate([rays.directions for rays in frames])
    with_features = settings.features == "field"
    surface = find_surface(field, origins, directions, settings.surface, with_features, settings.fog_density)
    ends = np.cumsum([len(rays.directions) for rays in frames])
    for first, last in zip([0, *ends], ends, strict=False):
        yield surface.select(slice(first, last))


def _found(job: TileExtraction, rays: Rays, surface: SurfacePoints, counts: Counter[str]) -> tuple[Rays, SurfacePoints]:
    """The rays that meet a surface whose values are numbers, and those surfaces."""
    channels, of_images = surface.features.shape[-1], job.settings.extraction.features == "images"
    if channels != job.feature_channels and not of_images:
        raise InputError(f"the field has {channels} channels, the feature space {job.feature_channels}; train it anew")
    values = np.concatenate([surface.points_world, surface.features, surface.rgb, surface.density[:, None]], -1)
    found = surface.found & np.isfinite(values).all(-1)
    counts["no_surface"] += int((~found).sum())
    rays, surface = Rays(rays.origin, rays.directions[found], rays.features[found]), surface.select(found)
    return rays, replace(surface, features=rays.features / np.float32(255)) if of_images else surface


def _both_ends(lattice: Lattice, rays: Rays, surface: SurfacePoints) -> tuple[Rays, SurfacePoints]:
    """Each ray twice: to where its surface begins, and to where it ends; once, to the middle, if a voxel holds both.

    So a voxel counts the rays that hit it.
    """
    half_m = surface.half_span_m.astype(np.float64)
    begins, ends = (surface.points_world + side * half_m[:, None] * rays.directions for side in (-1, 1))
    is_long = (lattice.voxel_of(begins) != lattice.voxel_of(ends)).any(-1)
    of_ray = np.concatenate([np.arange(len(half_m)), np.flatnonzero(is_long)])
    shift_m = np.concatenate([-half_m * is_long, half_m[is_long]])
    rays, surface = Rays(rays.origin, rays.directions[of_ray], rays.features[of_ray]), surface.select(of_ray)
    return rays, replace(
        surface,
        depth_m=(surface.depth_m + shift_m).astype(np.float32),
        points_world=surface.points_world + shift_m[:, None] * rays.directions,
    )


def _filtered(
    job: TileExtraction, surface: SurfacePoints, heights: CameraHeights, counts: Counter[str]
) -> NDArray[np.bool_]:
    """Which surface points (N,) are kept; every other one is counted under the first filter that takes it."""
    settings = job.settings.extraction
    above_m = surface.points_world[:, 2] - heights.at(surface.points_world)
    filters = {
        "depth": (surface.depth_m >= settings.min_depth_m) & (surface.depth_m <= settings.max_depth_m),
        "height": (above_m >= -settings.below_camera_m) & (above_m <= settings.above_camera_m),
        "density": surface.density > settings.min_density,
        "foreign_block": job.owned(job.lattice.block_of(job.lattice.voxel_of(surface.points_world))),
    }
    kept = np.ones(len(above_m), np.bool_)
    for name, passes in filters.items():
        counts[name] += int((kept & ~passes).sum())
        kept = kept & passes
    counts["points"] += int(kept.sum())
    return kept


def _seen_ends(
    job: TileExtraction, rays: Rays, surface: SurfacePoints, kept: NDArray[np.bool_], heights: CameraHeights
) -> NDArray[np.float64]:
    """Where (N, 3) the rays stop to tell about the ground below them.

    That is at the surface, at the greatest depth, or where they leave the mapped heights: a ray that passes
    30 m above a yard has not seen the yard. Rays of kept points go all the way.
    """
    settings, rising = job.settings.extraction, rays.directions[:, 2]
    above_m = rays.origin[2] - heights.at(rays.origin[None])[0]
    to_edge_m = np.where(rising > 0, settings.above_camera_m - above_m, settings.below_camera_m + above_m)
    leaves_m = np.maximum(to_edge_m, 0) / np.maximum(np.abs(rising), 1e-9)
    surface_m = np.clip(surface.depth_m, 0, settings.max_depth_m)
    length_m = np.where(kept, surface_m, np.minimum(surface_m, leaves_m))
    return rays.origin + length_m[:, None] * rays.directions


def voxel_batches(sums: VoxelSums, columns: ObservedColumns) -> Iterator[VoxelBatch]:
    """One batch for every superblock that has voxels or observed columns, in Morton order."""
    superblocks = {(x // SUPERBLOCK, y // SUPERBLOCK) for x, y in columns.blocks} | sums.superblocks
    ordered = np.array(list(superblocks), np.int64).reshape(-1, 2)
    for x, y in ordered[np.argsort(morton(ordered))].tolist():
        batch = _batch((x, y), sums, columns)
        if len(batch.block_index):
            yield batch


def _batch(superblock: Superblock, sums: VoxelSums, columns: ObservedColumns) -> VoxelBatch:
    means = sums.means(superblock)
    counts = np.bincount(means.cell, minlength=len(CELLS))
    blocks = (CELLS + np.array(superblock) * SUPERBLOCK).astype(np.int32)
    observed = np.stack([columns.bits((x, y)) for x, y in blocks.tolist()])
    used = (counts > 0) | observed.any((1, 2))
    return VoxelBatch(
        block_index=blocks[used],
        block_start=np.concatenate([[0], np.cumsum(counts[used])]).astype(np.int64),
        observed=observed[used],
        voxel=means.voxel,
        centroid=means.centroid,
        features=means.features,
        hits=means.hits,
        density=means.density,
        rgb=means.rgb,
        drives=means.drives,
    )
