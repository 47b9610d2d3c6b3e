"""What changed between two builds of a tile."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from presight_core.priors import PriorReader
from presight_core.priors.difference import tile_difference
from presight_core.priors.documents import GenerationTile
from presight_core.priors.example import ExampleTile
from presight_core.priors.tile_table import TileTable
from storage.priors import PriorStore
from storage.tile_groups import TileName

TILING = {"tiling_id": "tiling-1", "city": "town", "tiles": [{"tile_id": "t000", "centroid_m": [0.0, 0.0]}]}
EXAMPLE = ExampleTile(side_blocks=2)
DRIVES = ["a", "b", "c"]


def table(location: Path, batches, build: str) -> TileTable:
    """A build of these batches, opened."""
    store = PriorStore.open(location)
    store.create_city("town", EXAMPLE.lattice, "space", EXAMPLE.channel_count)
    entry = store.write_tile("town", TileName("t000", build), batches, DRIVES, {})
    head = store.generation("town")
    number = store.publish("town", {"t000": GenerationTile(entry, {})}, head.number if head else None, TILING)
    return PriorReader.open(location, "town", number).tile("t000")


@pytest.fixture
def batch():
    return next(replace(EXAMPLE, blocks_per_batch=4).batches())


def without_row(batch, row: int):
    columns = ("voxel", "centroid", "features", "hits", "density", "rgb", "drives")
    starts = batch.block_start - (batch.block_start > row)
    return replace(batch, block_start=starts, **{name: np.delete(getattr(batch, name), row, 0) for name in columns})


def test_added_removed_and_changed_voxels_are_told_apart(tmp_path: Path, batch):
    hits = batch.hits.copy()
    hits[[10, 120]] += 1
    old = table(tmp_path, [without_row(batch, 5)], "old")
    new = table(tmp_path, [without_row(replace(batch, hits=hits), 77)], "new")
    difference = tile_difference(old, new)
    assert len(difference.added) == 1
    assert len(difference.removed) == 1
    assert len(difference.changed) == 2
    assert len(difference.same) == len(batch.hits) - 4
    row = np.floor((old.points()[76] - EXAMPLE.lattice.origin_m) / EXAMPLE.lattice.voxel_m)  # row 77 before 5 was taken
    np.testing.assert_array_equal(difference.removed[0], row)


@pytest.mark.parametrize("name", ["centroid", "features", "density", "rgb"])
def test_a_change_in_any_column_counts(tmp_path: Path, batch, name: str):
    column = getattr(batch, name).copy()
    column.reshape(len(column), -1)[3, 0] += 3  # one step of the features
    old, new = table(tmp_path, [batch], "old"), table(tmp_path, [replace(batch, **{name: column})], "new")
    assert len(tile_difference(old, new).changed) == 1


def test_a_tile_that_is_new_or_gone_differs_in_all_its_voxels(tmp_path: Path, batch):
    only = table(tmp_path, [batch], "only")
    assert len(tile_difference(None, only).added) == len(batch.hits)
    assert len(tile_difference(only, None).removed) == len(batch.hits)
