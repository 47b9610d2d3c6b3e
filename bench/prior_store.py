"""A store of priors that a bench made: every tile of a city as its first generation."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from flows.plan import CityPlan
from presight_core.priors.documents import GenerationTile
from presight_core.priors.schema import VoxelBatch
from storage.priors import PriorStore
from storage.tile_groups import TileName


@dataclass(frozen=True)
class MadeTile:
    """The voxels of one tile; `drives` in bit order."""

    tile_id: str
    drives: tuple[str, ...]
    batches: Iterable[VoxelBatch]


def publish_city(
    store: PriorStore, plan: CityPlan, channel_count: int, tiles: Iterable[MadeTile], facts: dict[str, Any]
) -> None:
    """Write and publish the tiles of a city that the store does not know; prints a line for each."""
    names = {drive.drive_id: drive.name for drive in plan.drives}
    store.create_city(plan.city, plan.lattice, str(plan.space_id), channel_count)
    entries: dict[str, GenerationTile | None] = {}
    for tile in tiles:
        entry = store.write_tile(plan.city, TileName(tile.tile_id, "bench"), tile.batches, tile.drives, {"recipe": {}})
        print(f"{plan.city} {tile.tile_id}: {entry.voxel_count} voxels", flush=True)
        drive_names = {drive: names[drive] for drive in tile.drives}
        entries[tile.tile_id] = GenerationTile(entry, facts, {"drive_names": drive_names})
    store.publish(plan.city, entries, None, plan.tiling.to_json())
