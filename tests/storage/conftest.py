"""A small published city for the tests of the prior store and its reader; catalogs on every database."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from presight_core.priors import PriorReader
from presight_core.priors.documents import GenerationTile
from presight_core.priors.example import ExampleTile
from storage.catalog import Catalog
from storage.priors import PriorStore
from storage.tile_groups import TileName
from tests.storage.catalogs import ENGINES, new_postgres, postgres_template, sqlite_copy

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


@pytest.fixture(scope="session")
def catalog_template(tmp_path_factory) -> Path:
    """An empty SQLite catalog."""
    file = tmp_path_factory.mktemp("template") / "catalog.sqlite"
    Catalog.open(f"sqlite:///{file}")
    return file


@pytest.fixture(scope="session")
def postgres_catalog(postgres: str) -> str:
    """The name of a PostgreSQL database with an empty catalog, to copy."""
    return postgres_template(postgres)


@pytest.fixture(params=ENGINES)
def url(request, tmp_path) -> str:
    """The URL of an empty catalog, once on every database."""
    if request.param == "postgres":
        template = request.getfixturevalue("postgres_catalog")
        return new_postgres(request.getfixturevalue("postgres"), template=template)
    file = sqlite_copy(request.getfixturevalue("catalog_template"), tmp_path)
    return f"sqlite:///{file}" if request.param == "sqlite" else f"sqlite+pysqlite:///{file}"


@pytest.fixture(params=ENGINES)
def new_url(request, tmp_path) -> str:
    """The URL of a database without any schema."""
    if request.param == "postgres":
        return new_postgres(request.getfixturevalue("postgres"))
    file = tmp_path / "new.sqlite"
    return f"sqlite:///{file}" if request.param == "sqlite" else f"sqlite+pysqlite:///{file}"
