"""Priors of the same fields with other features: `python -m bench.swapped_features WORKSPACE OTHER STORE CITY...`.

WORKSPACE has built the cities, and its trained fields are used again; OTHER has the features of another network for the
same drives. Voxels are made where the fields' surfaces are, of what OTHER's network says of those pixels, as
`extraction.features = "images"` does. What differs between the two priors is the features alone. Prints a line for
each tile.
"""

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from bench.field_tile import open_tile
from bench.prior_store import MadeTile, publish_city
from flows.plan import CityPlan
from presight_core.config import CitySettings
from presight_core.errors import InputError
from presight_core.field.checkpoint import load_field
from stages.extraction import extract_tile
from storage.priors import PriorStore
from storage.workspace import Workspace


def main() -> None:
    """Write and publish every city."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("other", type=Path)
    parser.add_argument("store", type=Path)
    parser.add_argument("city", nargs="+")
    options = parser.parse_args()
    for city in options.city:
        first = open_tile(options.other, city, 0, [])
        tiles = swapped_tiles(options.workspace, options.other, first.plan)
        facts = {"swapped_features": True}
        publish_city(PriorStore.open(options.store), first.plan, first.job.feature_channels, tiles, facts)


def swapped_tiles(workspace: Path, other: Path, plan: CityPlan) -> Iterator[MadeTile]:
    """The tiles of a city. Raises InputError where the two workspaces cut it differently, or a field is missing."""
    if open_tile(workspace, plan.city, 0, []).plan.tiling.to_json() != plan.tiling.to_json():
        raise InputError(f"{plan.city}: {workspace} and {other} have other tiles; give both the same tiling settings")
    for index, planned in enumerate(plan.tiling.tiles):
        tile = open_tile(other, plan.city, index, [])
        field = load_field(field_folder(Workspace.open(workspace), plan.city, planned.tile_id), "cpu")
        job = replace(tile.extraction, settings=with_features_of_images(tile.extraction.settings))
        with tempfile.TemporaryDirectory() as scratch:
            found = extract_tile(job, field, tile.source, Path(scratch))
            yield MadeTile(planned.tile_id, found.drives, found.batches)


def field_folder(workspace: Workspace, city: str, tile_id: str) -> Path:
    """Where a tile's only trained field is kept. Raises InputError if there are several, or none."""
    found = sorted(workspace.scratch(city, tile_id, "any").parent.glob("*/field"))
    if len(found) != 1:
        raise InputError(f"{city} {tile_id}: {len(found)} trained fields in {workspace.caches}; build it once")
    return found[0]


def with_features_of_images(settings: CitySettings) -> CitySettings:
    """The settings with features from images."""
    return settings.model_copy(update={"extraction": settings.extraction.model_copy(update={"features": "images"})})


if __name__ == "__main__":
    main()
