"""A small published city, and places in it."""

from pathlib import Path

import pytest

from presight_core.priors.documents import GenerationTile
from presight_core.priors.example import ExampleTile
from storage.priors import PriorStore
from storage.tile_groups import TileName

TILING = {"tiling_id": "tiling-1", "city": "town", "tiles": [{"tile_id": "t000", "centroid_m": [0.0, 0.0]}]}


def publish(
    location: Path, build: str, parent: int | None, seed: int = 0, drive_names: dict[str, str] | None = None
) -> None:
    """Publish a generation of the city "town": one tile of 51 x 51 m around the world's origin, seen by 3 drives.

    drive_names: scene names of its drives, drive-0 to drive-2; scene-0000 and so on if not given.
    """
    example = ExampleTile(seed=seed, voxels_per_block=400)
    store = PriorStore.open(location)
    if parent is None:
        store.create_city("town", example.lattice, "space-1", example.channel_count)
    drives = [f"drive-{number}" for number in range(example.drive_count)]
    entry = store.write_tile("town", TileName("t000", build), example.batches(), drives, {"recipe": {}})
    names = drive_names or {drive: f"scene-{number:04d}" for number, drive in enumerate(drives)}
    tile = GenerationTile(entry, {"stage": "test"}, {"drive_names": names})
    store.publish("town", {"t000": tile}, parent, TILING)


@pytest.fixture(scope="session")
def town(tmp_path_factory) -> Path:
    """A store with generation 1 of "town"; not to be written to."""
    location = tmp_path_factory.mktemp("town") / "store"
    publish(location, "build-1", None)
    return location
