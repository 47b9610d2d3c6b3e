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
from presight_core.priors.documents import GenerationTile
from presight_core.priors.schema import VoxelBatch
from stages.camera_heights import CameraHeights
from stages.extraction import chosen_rows, voxel_batches
from stages.observed_columns import ObservedColumns
from stages.voxel_sums import Samples, VoxelSums
from storage.priors import PriorStore
from storage.tile_groups import TileName

DENSITY = 100.0  # per metre: a surface


def main() -> None:
    """Write and publish every city."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("store", type=Path)
    parser.add_argument("city", nargs="+")
    options = parser.parse_args()
    for city in options.city:
        publish(options.workspace, PriorStore.open(options.store), city)


def publish(workspace: Path, store: PriorStore, city: str) -> None:
    """All tiles of a city as its first generation."""
    plan = open_tile(workspace, city, 0, []).plan
    names = {drive.drive_id: drive.name for drive in plan.drives}
    tiles: dict[str, GenerationTile | None] = {}
    for index, planned in enumerate(plan.tiling.tiles):
        opened = open_tile(workspace, city, index, [])
        truth = SceneTruth(plan.drives, opened.job.frames)
        tile = SeenTile(opened.plan, opened.job, opened.extraction, opened.source, truth)
        if not tiles:
            store.create_city(city, plan.lattice, str(plan.space_id), tile.job.feature_channels)
        with tempfile.TemporaryDirectory() as scratch:
            drives, batches = tile.extraction.drives, true_batches(tile, Path(scratch))
            name = TileName(planned.tile_id, "true-depth")
            entry = store.write_tile(city, name, batches, drives, {"recipe": {}})
        print(f"{city} {planned.tile_id}: {entry.voxel_count} voxels", flush=True)
        chosen_names = {drive: names[drive] for drive in drives}
        tiles[planned.tile_id] = GenerationTile(entry, {"true_depth": True}, {"drive_names": chosen_names})
    store.publish(city, tiles, None, plan.tiling.to_json())


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
