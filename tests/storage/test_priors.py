"""Writing tiles and publishing generations."""

import json
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from presight_core.errors import ConflictError, InputError, NotFoundError, StoreError
from presight_core.grid import Lattice, morton
from presight_core.priors import schema
from presight_core.priors.documents import GenerationTile
from presight_core.priors.schema import array_specs
from storage import tile_groups
from storage.priors import PriorStore
from storage.tile_groups import TileName


def test_what_was_written_reads_back(town):
    table = town.reader().tile("t000")
    batches = list(town.example.batches())
    for name in ("block_index", "observed", "voxel", "centroid", "features", "hits", "density", "rgb", "drives"):
        expected = np.concatenate([getattr(batch, name) for batch in batches])
        np.testing.assert_array_equal(table.all_rows(name), expected, err_msg=name)
    counts = np.concatenate([np.diff(batch.block_start) for batch in batches])
    np.testing.assert_array_equal(table.block_start, np.concatenate([[0], np.cumsum(counts)]))


def test_a_tile_is_sorted_by_block_and_voxel(town):
    table = town.reader().tile("t000")
    keys = np.repeat(morton(table.block_index), np.diff(table.block_start)).tolist()
    rows = list(zip(keys, table.all_rows("voxel").tolist(), strict=True))
    assert rows == sorted(set(rows))


@pytest.mark.parametrize("chunk_rows", [7, 64])
def test_chunks_and_slabs_do_not_change_what_is_stored(empty_town, monkeypatch, chunk_rows: int):
    whole = empty_town.write("t000", "build-1")
    monkeypatch.setattr(schema, "CHUNK_ROWS", chunk_rows)
    monkeypatch.setattr(schema, "BLOCK_CHUNK_ROWS", 5)
    monkeypatch.setattr(tile_groups, "SLAB_CHUNKS", 2)
    pieces = empty_town.write("t000", "build-2")
    monkeypatch.undo()  # readers take the chunks' size from the store
    assert pieces.entry.digest == whole.entry.digest
    empty_town.store.publish("town", {"t000": whole}, None, empty_town.tiling)
    empty_town.store.publish("town", {"t000": pieces}, 1)
    expected, window = (empty_town.reader(number).window(np.eye(4)) for number in (1, 2))
    np.testing.assert_array_equal(window.features, expected.features)
    np.testing.assert_array_equal(window.points_world, expected.points_world)


@pytest.mark.parametrize("step", [1, 3, 5])
def test_features_are_kept_to_within_half_a_step(tmp_path: Path, step: int):
    features = np.arange(256, dtype=np.uint8)[:, None]
    found = schema.unpack_features(schema.pack_features(features, step), step)
    assert np.abs(found.astype(int) - features).max() == step // 2
    assert found[0] == 0
    assert found[-1] == 255


def test_a_feature_step_that_does_not_divide_255_is_refused(empty_town):
    with pytest.raises(InputError, match="does not divide 255"):
        empty_town.store.create_city("other", Lattice(), "space-1", 8, feature_step=4)


def test_the_digest_names_the_content(empty_town):
    first = empty_town.write("t000", "build-1").entry
    again = empty_town.write("t000", "build-2").entry
    other = empty_town.write("t000", "build-3", replace(empty_town.example, seed=1)).entry
    assert first.digest == again.digest != other.digest
    assert len(first.digest) == 64


def test_the_entry_tells_the_extent(empty_town):
    entry = empty_town.write("t000", "build-1").entry
    assert entry.block_count == 16
    assert entry.voxel_count == 12 * 50  # each of the four batches ends with an empty block
    assert entry.block_bounds == (-2, -2, 1, 1)
    assert entry.bytes == sum(
        file.stat().st_size for file in (empty_town.location / "town" / entry.path).rglob("*") if file.is_file()
    )


def test_the_group_document_states_what_the_tile_is(town):
    attributes = json.loads((town.location / "town/tiles/t000/build-1/zarr.json").read_text())["attributes"]
    assert attributes["format_version"] == "1.0"
    assert attributes["space_id"] == "space-1"
    assert attributes["lattice"]["voxel_m"] == 0.4
    assert attributes["drives"] == ["drive-0", "drive-1", "drive-2"]
    assert attributes["voxel_count"] == 600
    assert attributes["recipe"] == {"stage": "test"}


def test_nothing_but_arrays_and_documents_lies_in_the_store(town):
    documents = {str(file.relative_to(town.location)) for file in town.location.rglob("*.json")}
    arrays = {name for name in documents if Path(name).parent.name in array_specs(8, 3, 32)}
    assert documents - arrays == {
        "town/city.json",
        "town/generations/00000001.json",
        "town/tiles/t000/build-1/zarr.json",
    }


def test_an_empty_tile_can_be_written_and_read(empty_town):
    entry = empty_town.store.write_tile("town", TileName("t000", "build-1"), [], ["drive-0"], {})
    assert entry.voxel_count == entry.block_count == 0
    empty_town.store.publish("town", {"t000": GenerationTile(entry, {})}, None, empty_town.tiling)
    assert len(empty_town.reader().window(np.eye(4))) == 0


def test_batches_out_of_order_are_refused(empty_town):
    batches = list(empty_town.example.batches())
    with pytest.raises(AssertionError, match="batches ascend"):
        empty_town.store.write_tile("town", TileName("t000", "build-1"), batches[::-1], ["a", "b", "c"], {})


def test_a_build_is_written_once(empty_town):
    empty_town.write("t000", "build-1")
    with pytest.raises(ConflictError, match="was written before"):
        empty_town.write("t000", "build-1")


def test_an_unfinished_build_is_cleared_and_written_again(empty_town):
    def breaks_off():
        yield from list(empty_town.example.batches())[:2]
        raise RuntimeError("power cut")

    with pytest.raises(RuntimeError):
        empty_town.store.write_tile("town", TileName("t000", "build-1"), breaks_off(), ["a", "b", "c"], {})
    stray = empty_town.location / "town/tiles/t000/build-1/hits/c/99"
    stray.parent.mkdir(parents=True, exist_ok=True)
    stray.write_bytes(b"left over")
    whole = empty_town.write("t000", "build-1")
    assert not stray.exists()
    assert whole.entry.digest == empty_town.write("t000", "build-2").entry.digest


def test_an_unfinished_build_cannot_be_published(empty_town):
    tile = empty_town.write("t000", "build-1")
    (empty_town.location / "town/tiles/t000/build-1/zarr.json").unlink()
    with pytest.raises(StoreError, match="not a finished build"):
        empty_town.store.publish("town", {"t000": tile}, None, empty_town.tiling)


def test_a_city_is_made_once(empty_town):
    empty_town.store.create_city("town", Lattice(), "space-1", 8)
    with pytest.raises(ConflictError, match="space-2"):
        empty_town.store.create_city("town", Lattice(), "space-2", 8)


def test_nothing_is_published_at_first(empty_town):
    assert empty_town.store.generation("town") is None
    assert empty_town.store.generations("town") == []
    with pytest.raises(NotFoundError):
        empty_town.store.generation("town", 3)


def test_generations_form_a_chain_and_keep_other_tiles(town):
    number = town.store.publish("town", {"t001": town.write("t001", "build-1")}, 1)
    generation = town.store.generation("town")
    assert generation is not None
    assert (number, generation.number, generation.parent) == (2, 2, 1)
    assert sorted(generation.tiles) == ["t000", "t001"]
    assert generation.tiling == town.tiling
    assert generation.tiles["t001"].recipe["build"] == "build-1"


def test_disjoint_tiles_published_meanwhile_are_merged(town):
    town.store.publish("town", {"t001": town.write("t001", "build-1")}, 1)
    number = town.store.publish("town", {"t002": town.write("t002", "build-1")}, 1)  # planned before t001 came
    generation = town.store.generation("town", number)
    assert generation is not None
    assert sorted(generation.tiles) == ["t000", "t001", "t002"]
    assert generation.parent == 2


def test_the_same_tile_published_meanwhile_is_a_conflict(town):
    town.store.publish("town", {"t000": town.write("t000", "build-2")}, 1)
    with pytest.raises(ConflictError, match="t000"):
        town.store.publish("town", {"t000": town.write("t000", "build-3")}, 1)
    assert town.store.generations("town") == [1, 2]


def test_a_first_publish_that_comes_second_is_a_conflict(town):
    with pytest.raises(ConflictError, match="t000"):
        town.store.publish("town", {"t000": town.write("t000", "build-2")}, None, town.tiling)


def test_a_publish_that_loses_the_race_reads_again_and_merges(town, monkeypatch):
    """Between our reading of generation 1 and our put, somebody else puts generation 2."""
    other, mine = town.write("t001", "build-1"), town.write("t002", "build-1")
    read = PriorStore.generation
    raced = []

    def generation(store, city, number=None):
        found = read(store, city, number)
        if not raced:
            raced.append(True)
            town.store.publish("town", {"t001": other}, 1)
        return found

    monkeypatch.setattr(PriorStore, "generation", generation)
    assert town.store.publish("town", {"t002": mine}, 1) == 3
    final = read(town.store, "town")
    assert final is not None
    assert sorted(final.tiles) == ["t000", "t001", "t002"]


def test_racing_writers_all_get_in_with_a_linear_history(town):
    tiles = {name: town.write(name, "build-2") for name in ("t001", "t002")}
    threads = [
        threading.Thread(target=town.store.publish, args=("town", {name: tile}, 1)) for name, tile in tiles.items()
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert town.store.generations("town") == [1, 2, 3]
    final = town.store.generation("town")
    assert final is not None
    assert sorted(final.tiles) == ["t000", "t001", "t002"]


def test_a_new_tiling_keeps_only_tiles_that_stayed_in_place(town):
    town.store.publish("town", {"t001": town.write("t001", "build-1")}, 1)
    moved = {
        "tiling_id": "tiling-2",
        "city": "town",
        "tiles": [{"tile_id": "t000", "centroid_m": [0.0, 0.0]}, {"tile_id": "t001", "centroid_m": [7.0, 7.0]}],
    }
    town.store.publish("town", {}, 2, moved)
    generation = town.store.generation("town")
    assert generation is not None
    assert sorted(generation.tiles) == ["t000"]


def test_a_tile_outside_the_tiling_is_refused(town):
    with pytest.raises(InputError, match="t009"):
        town.store.publish("town", {"t009": town.write("t009", "build-1")}, 1)


def test_the_first_generation_needs_a_tiling(empty_town):
    with pytest.raises(InputError, match="tiling"):
        empty_town.store.publish("town", {"t000": empty_town.write("t000", "build-1")}, None)


def test_documents_are_kept_once(empty_town):
    store = empty_town.store
    store.save_document("town", "tilings", "tiling-1", empty_town.tiling)
    store.save_document("town", "tilings", "tiling-1", empty_town.tiling)
    assert store.document("town", "tilings", "tiling-1") == empty_town.tiling
    assert (empty_town.location / "town/tilings/tiling-1.json").exists()
    with pytest.raises(ConflictError):
        store.save_document("town", "tilings", "tiling-1", {"other": 1})
    with pytest.raises(NotFoundError):
        store.document("town", "tilings", "tiling-2")


def test_size_on_disk_counts_every_file(town):
    files = [file for file in (town.location / "town").rglob("*") if file.is_file()]
    assert town.store.size_bytes("town") == sum(file.stat().st_size for file in files)


def test_a_store_can_be_a_file_url(tmp_path: Path):
    url = f"file://{tmp_path}/a%20store"
    PriorStore.open(url).create_city("town", Lattice(), "space-1", 8)
    assert (tmp_path / "a store/town/city.json").exists()
    assert PriorStore.open(url).city("town").space_id == "space-1"


@pytest.mark.parametrize("location", ["nonsense://place", "/proc/nowhere/store"])
def test_a_location_that_cannot_be_written_is_a_store_error(location: str):
    with pytest.raises(StoreError, match=location):
        PriorStore.open(location)


def test_a_publisher_with_an_older_fencing_number_is_refused_and_changes_nothing(town):
    store = town.store
    store.publish("town", {"t001": town.write("t001", "build-1")}, 1, fence=7)
    with pytest.raises(ConflictError, match="fencing number 7, this run 6"):
        store.publish("town", {"t002": town.write("t002", "build-1")}, 1, fence=6)
    assert store.generations("town") == [1, 2]
    assert store.fence("town") == 7


def test_the_fence_outlives_publishers_that_have_none(town):
    town.store.raise_fence("town", 5)
    town.store.publish("town", {"t001": town.write("t001", "build-1")}, 1)
    assert town.store.fence("town") == 5


def test_the_fence_outlives_a_rollback(town):
    town.store.raise_fence("town", 5)
    town.store.rollback("town", 1)
    assert town.store.fence("town") == 5


def test_raising_the_fence_shows_the_same_tiles_and_is_done_once(town):
    town.store.raise_fence("town", 5)
    town.store.raise_fence("town", 5)
    first, second = (town.store.generation("town", number) for number in (1, 2))
    assert town.store.generations("town") == [1, 2]
    assert second == replace(first, number=2, parent=1, fence=5, parent_sha256=second.parent_sha256)
    with pytest.raises(ConflictError, match="may no longer publish"):
        town.store.raise_fence("town", 4)


def test_a_publisher_that_is_about_to_put_when_the_fence_rises_is_refused(town, monkeypatch):
    """It has read generation 1 and made number 2 of it; somebody raises the fence; then it goes on."""
    tile = town.write("t001", "build-1")
    commit = PriorStore._commit

    def late(store, generation):
        monkeypatch.setattr(PriorStore, "_commit", commit)
        town.store.raise_fence("town", 2)
        return commit(store, generation)

    monkeypatch.setattr(PriorStore, "_commit", late)
    with pytest.raises(ConflictError, match="taken for dead"):
        town.store.publish("town", {"t001": tile}, 1, fence=1)
    final = town.store.generation("town")
    assert final is not None
    assert (final.number, sorted(final.tiles)) == (2, ["t000"])


def test_a_city_without_generations_can_be_fenced_and_then_published(empty_town):
    store = empty_town.store
    store.raise_fence("unknown-city", 3)  # nothing to fence
    store.raise_fence("town", 3)
    tile = empty_town.write("t000", "build-1")
    with pytest.raises(ConflictError):
        store.publish("town", {"t000": tile}, None, empty_town.tiling, fence=2)
    assert store.publish("town", {"t000": tile}, None, empty_town.tiling, fence=3) == 2
    assert len(empty_town.reader().tiles) == 1
