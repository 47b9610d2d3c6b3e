"""Priors as perfect fields would give them: `python -m bench.true_depth_priors WORKSPACE STORE CITY...`.

WORKSPACE has built the embedded cities: their tiles, frames, labels and features are used again. Voxels are made where
the images' true depth meets a surface, of what the networks say of that pixel; nothing is trained. A model that gains
from these and not from the real priors tells that its priors are what holds it back. Prints a line for each tile.
"""

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bench.field_quality import SeenTile, pixels_of, true_hits
from bench.field_tile import open_tile
from bench.field_truth import SceneTruth
from bench.prior_store import MadeTile, publish_city
from flows.plan import CityPlan
from presight_core.priors.schema import VoxelBatch
from stages.camera_heights import CameraHeights
from stages.extraction import chosen_rows, voxel_batches
from stages.observed_columns import ObservedColumns
from stages.voxel_sums import Samples, VoxelSums
from storage.priors import PriorStore

DENSITY = 100.0  # per metre: a surface


def main() -> None:
    """Write and publish every city."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("store", type=Path)
    parser.add_argument("city", nargs="+")
    options = parser.parse_args()
    for city in options.city:
        first = open_tile(options.workspace, city, 0, [])
        tiles = true_tiles(options.workspace, first.plan)
        publish_city(
            PriorStore.open(options.store), first.plan, first.job.feature_channels, tiles, {"true_depth": True}
        )


def true_tiles(workspace: Path, plan: CityPlan) -> Iterator[MadeTile]:
    """The tiles of a city."""
    for index, planned in enumerate(plan.tiling.tiles):
        opened = open_tile(workspace, plan.city, index, [])
        truth = SceneTruth(plan.drives, opened.job.frames)
        tile = SeenTile(opened.plan, opened.job, opened.extraction, opened.source, truth)
        with tempfile.TemporaryDirectory() as scratch:
            yield MadeTile(planned.tile_id, tile.extraction.drives, true_batches(tile, Path(scratch)))


def true_batches(tile: SeenTile, scratch: Path) -> Iterator[VoxelBatch]:
    """The tile's voxels, as `stages.extraction` makes them of a field."""
    job, settings = tile.extraction, tile.job.settings.extraction
    sums = VoxelSums(job.lattice, job.feature_channels, len(job.drives), scratch)
    columns, heights = ObservedColumns(job.lattice, settings.max_depth_m), CameraHeights(job.frames.positions)
    for row in chosen_rows(job):
        hits = true_hits(tile, row, settings.pixel_stride, heights)
        rgb, features = (values[hits.pixels] for values in pixels_of(tile, row, settings.pixel_stride))
        density = np.full(len(hits.pixels), DENSITY, np.float32)
        columns.add(job.frames.positions[row], hits.points_world)
        sums.add(Samples(hits.points_world, features, rgb, density), job.drives.index(str(job.frames.drive_id[row])))
    columns.keep(job.owned)
    sums.finish(settings.min_hits)
    return voxel_batches(sums, columns)


if __name__ == "__main__":
    main()
