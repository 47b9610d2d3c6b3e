"""A small published city for the tests of the prior store and its reader."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from presight_core.priors import PriorReader
from presight_core.priors.documents import GenerationTile
from presight_core.priors.example import ExampleTile
from storage.priors import PriorStore
from storage.tile_groups import TileName

TILING = {
    "tiling_id": "tiling-1",
    "city": "town",
    "tiles": [{"tile_id": f"t00{number}", "centroid_m": [100.0 * number, 0.0]} for number in range(3)],
}


@dataclass(frozen=True)
class Town:
    """A store with the city "town", made of example tiles."""

    location: Path
    store: PriorStore
    example: ExampleTile
    tiling: dict

    def write(self, tile_id: str, build: str, example: ExampleTile | None = None) -> GenerationTile:
        example = example or self.example
        drives = [f"drive-{number}" for number in range(example.drive_count)]
        attributes = {"recipe": {"stage": "test"}}
        entry = self.store.write_tile("town", TileName(tile_id, build), example.batches(), drives, attributes)
        return GenerationTile(entry, {"stage": "test", "build": build})

    def reader(self, generation: int | None = None) -> PriorReader:
        return PriorReader.open(self.location, "town", generation)


@pytest.fixture
def empty_town(tmp_path: Path) -> Town:
    example = ExampleTile()
    store = PriorStore.open(tmp_path / "store")
    store.create_city("town", example.lattice, "space-1", example.channel_count)
    return Town(tmp_path / "store", store, example, TILING)


@pytest.fixture
def town(empty_town: Town) -> Town:
    """A town whose tile t000 is published as generation 1."""
    empty_town.store.publish("town", {"t000": empty_town.write("t000", "build-1")}, None, TILING)
    return empty_town
