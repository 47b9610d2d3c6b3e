"""Reading windows of a stored city."""

import json
import multiprocessing
import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

from presight_core import frames
from presight_core.errors import InputError, NotFoundError, StoreError
from presight_core.priors import PriorReader, schema
from presight_core.priors.documents import encode
from presight_core.priors.location import ReadLocation
from presight_core.priors.schema import VoxelBatch, array_specs, unpack_columns, unpack_voxels

RANGES = {"x_m": (-12.0, 9.0), "y_m": (-7.0, 5.0), "z_m": (-1.0, 4.0)}
POSES = {
    "level": frames.planar_transform(3.0, -2.0, 0.0),
    "rotated": frames.planar_transform(-4.0, 5.0, 2.2),
    "at the edge": frames.planar_transform(15.0, -24.0, -0.7),
    "tilted": frames.transform(frames.rotation_from_quaternion([1.0, 0.08, -0.05, 0.4]), [1.0, 2.0, 0.5]),
}


def whole_tile(batches: list[VoxelBatch], lattice) -> dict[str, np.ndarray]:
    """Every voxel of a tile, the slow way: one at a time."""
    points, rows = [], {name: [] for name in ("features", "hits", "density", "rgb")}
    for batch in batches:
        for block, (start, end) in enumerate(zip(batch.block_start[:-1], batch.block_start[1:], strict=True)):
            for row in range(start, end):
                voxel = unpack_voxels(batch.voxel[row : row + 1], batch.block_index[block : block + 1], lattice)[0]
                points.append((voxel + (batch.centroid[row] + 0.5) / 256) * lattice.voxel_m + lattice.origin_m)
                for name, column in rows.items():
                    column.append(getattr(batch, name)[row])
    return {"points_world": np.array(points), **{name: np.array(column) for name, column in rows.items()}}


def voxels_in_box(voxels: dict[str, np.ndarray], pose: np.ndarray) -> dict[str, np.ndarray]:
    points_ego = frames.apply(frames.invert(pose), voxels["points_world"])
    ranges = [RANGES["x_m"], RANGES["y_m"], RANGES["z_m"]]
    inside = np.ones(len(points_ego), np.bool_)
    for axis, (low, high) in enumerate(ranges):
        inside &= (points_ego[:, axis] >= low) & (points_ego[:, axis] < high)
    return {name: column[inside] for name, column in {**voxels, "points_ego": points_ego}.items()}


@pytest.mark.parametrize("name", POSES)
def test_window_holds_exactly_the_voxels_in_the_box(town, name: str):
    voxels = whole_tile(list(town.example.batches()), town.example.lattice)
    expected = voxels_in_box(voxels, POSES[name])
    window = town.reader().window(POSES[name], **RANGES)
    assert len(window) == len(expected["hits"]) > 10
    np.testing.assert_allclose(window.points_world, expected["points_world"], atol=1e-9)
    np.testing.assert_allclose(window.points_ego, expected["points_ego"], atol=1e-5)
    for column in ("features", "hits", "density", "rgb"):
        np.testing.assert_array_equal(getattr(window, column), expected[column])


@pytest.mark.parametrize("left_out", [{"drive-1"}, {"drive-0", "drive-2"}, {"drive-0", "drive-1", "drive-2"}])
def test_a_window_without_drives_holds_the_voxels_that_others_saw(town, left_out):
    reader = town.reader()
    kept = sum(1 << bit for bit in range(3) if f"drive-{bit}" not in left_out)
    seen = np.concatenate([batch.drives[:, 0] & kept > 0 for batch in town.example.batches()])
    expected = reader.tile("t000").all_rows("hits")[seen]
    window = reader.window(POSES["level"], (-60.0, 60.0), (-60.0, 60.0), (-90.0, 90.0), without_drives=left_out)
    np.testing.assert_array_equal(window.hits, expected)


def test_leaving_out_an_unknown_drive_changes_nothing(town):
    whole, same = (town.reader().window(POSES["level"], without_drives=names) for names in ((), ("elsewhere",)))
    np.testing.assert_array_equal(whole.points_world, same.points_world)


def test_observed_columns_are_those_of_the_tile_inside_the_footprint(town):
    pose, lattice = POSES["rotated"], town.example.lattice
    window = town.reader().window(pose, **RANGES)
    seen = set()
    for batch in town.example.batches():
        for block, flags in zip(batch.block_index, unpack_columns(batch.observed), strict=True):
            for x, y in np.argwhere(flags) + block * lattice.block_columns:
                east, north = (np.array([x, y]) + 0.5) * lattice.voxel_m
                ahead, left, _ = frames.apply(frames.invert(pose), [[east, north, 0.0]])[0]
                if -12 <= ahead < 9 and -7 <= left < 5:
                    seen.add((int(x), int(y)))
    found = {tuple(column) for column in (np.argwhere(window.observed) + window.observed_origin).tolist()}
    assert found == seen
    assert len(found) > 100


def test_coverage_is_the_observed_share_of_the_ground(town):
    window = town.reader().window(POSES["level"], **RANGES)
    columns = 21.0 * 12.0 / 0.4**2
    assert window.coverage == pytest.approx(window.observed.sum() / columns, rel=0.05)
    assert 0.4 < window.coverage < 0.6  # half of the example's columns are observed


def test_a_window_outside_the_city_is_empty(town):
    window = town.reader().window(frames.planar_transform(5000.0, 5000.0, 0.3))
    assert len(window) == 0
    assert window.features.shape == (0, 8)
    assert window.points_ego.shape == window.points_world.shape == (0, 3)
    assert not window.observed.any()
    assert window.coverage == 0
    assert window.tiles == ()


def test_a_pinned_reader_does_not_see_later_generations(town):
    pinned = town.reader()
    before = len(pinned.window(POSES["level"]))
    town.store.publish("town", {"t001": town.write("t001", "build-1")}, 1)
    assert len(pinned.window(POSES["level"])) == before
    assert town.reader().tiles == ("t000", "t001")
    assert town.reader(generation=1).tiles == ("t000",)


def read_paths(reader: PriorReader, monkeypatch) -> list[str]:
    """The objects that the reader's source is asked for from now on."""
    asked = []
    read = ReadLocation.read
    monkeypatch.setattr(ReadLocation, "read", lambda source, path: asked.append(path) or read(source, path))
    return asked


def test_only_chunks_of_the_needed_rows_are_read(empty_town, monkeypatch):
    monkeypatch.setattr(schema, "CHUNK_ROWS", 8)
    publish_first(empty_town)
    table = empty_town.reader().tile("t000")
    asked = read_paths(empty_town.reader(), monkeypatch)
    wanted = np.array([3, 4, 500])
    expected = np.concatenate([batch.hits for batch in empty_town.example.batches()])[wanted]
    np.testing.assert_array_equal(table.rows("hits", wanted), expected)
    assert [path.partition("hits/")[2] for path in asked] == ["c/0", "c/62"]


def publish_first(town) -> None:
    town.store.publish("town", {"t000": town.write("t000", "build-1")}, None, town.tiling)


def test_looks_are_read_only_where_voxels_are_inside(empty_town, monkeypatch):
    monkeypatch.setattr(schema, "FEATURE_CHUNK_ROWS", 8)
    monkeypatch.setattr(schema, "NARROW_BYTES", 4)  # so that features of 8 channels are cut finely
    publish_first(empty_town)
    reader = empty_town.reader()
    asked = read_paths(reader, monkeypatch)
    window = reader.window(POSES["level"], (-4, 4), (-4, 4), (-90, 90))
    chunks = [path for path in asked if "/features/" in path]
    assert 0 < len(chunks) <= len(window)


def test_a_window_read_again_comes_from_memory(town, monkeypatch):
    reader = town.reader()
    expected = reader.window(POSES["level"])
    asked = read_paths(reader, monkeypatch)
    np.testing.assert_array_equal(reader.window(POSES["level"]).features, expected.features)
    assert asked == []


def test_memory_of_decoded_chunks_is_bounded(empty_town, monkeypatch):
    monkeypatch.setattr(schema, "CHUNK_ROWS", 64)
    publish_first(empty_town)
    reader = PriorReader.open(empty_town.location, "town", cache_bytes=4000)
    random = np.random.default_rng(0)
    for _ in range(30):
        reader.window(frames.planar_transform(*random.uniform(-20, 20, 2), 0.0), (-5, 5), (-5, 5))
        assert reader._cache.size_bytes <= 4000
    assert reader._cache.size_bytes > 2000


def test_without_a_cache_a_window_is_the_same(town):
    reader = PriorReader.open(town.location, "town", cache_bytes=0)
    np.testing.assert_array_equal(reader.window(POSES["tilted"]).hits, town.reader().window(POSES["tilted"]).hits)
    assert reader._cache.size_bytes == 0


def test_batched_windows_equal_single_ones(town):
    reader = town.reader()
    for window, pose in zip(reader.windows(list(POSES.values()), **RANGES), POSES.values(), strict=True):
        np.testing.assert_array_equal(window.points_world, reader.window(pose, **RANGES).points_world)
    assert reader.windows([]) == []


def test_batched_windows_of_a_remote_store_are_fetched_together(town, monkeypatch):
    batches = []
    read_all = ReadLocation.read_all
    monkeypatch.setattr(ReadLocation, "is_remote", True)
    monkeypatch.setattr(
        ReadLocation, "read_all", lambda source, paths: batches.append(len(paths)) or read_all(source, paths)
    )
    reader = town.reader()
    windows = reader.windows(list(POSES.values()), **RANGES)
    assert [size for size in batches if size] == [1, 1, 1, 2, 4]  # three block tables, then places, then looks
    monkeypatch.undo()
    for window, pose in zip(windows, POSES.values(), strict=True):
        np.testing.assert_array_equal(window.hits, town.reader().window(pose, **RANGES).hits)


def test_a_window_tells_which_tile_was_never_built(town):
    """Of the tiling's three tiles, at x = 0, 100 and 200 m, only the first is published."""
    assert town.reader().window(POSES["level"], (-5, 5), (-5, 5)).missing_tiles == ()
    far = frames.planar_transform(60.0, 0.0, 0.0)
    assert town.reader().window(far, (-20, 20), (-5, 5)).missing_tiles == ("t001",)
    assert town.reader().window(far, (-20, 120), (-5, 5)).missing_tiles == ("t001", "t002")


def test_a_tag_opens_the_generation_that_it_names(town):
    town.store.tag("town", "release", 1)
    town.store.publish("town", {"t001": town.write("t001", "build-1")}, 1)
    assert PriorReader.open(town.location, "town", "release").generation.number == 1
    with pytest.raises(NotFoundError, match="no tag elsewhere"):
        PriorReader.open(town.location, "town", "elsewhere")


@pytest.mark.parametrize(
    "arguments",
    [
        {"world_from_ego": np.full((4, 4), np.nan)},
        {"world_from_ego": np.diag([2.0, 2.0, 2.0, 1.0])},
        {"world_from_ego": np.eye(3)},
        {"world_from_ego": frames.transform([[1, 0, 0], [0, 0, -1], [0, 1, 0]], [0, 0, 0])},
        {"world_from_ego": np.eye(4), "x_m": (5.0, 5.0)},
    ],
    ids=["nan", "scaled", "3x3", "on its side", "empty range"],
)
def test_a_meaningless_window_is_an_input_error(town, arguments: dict):
    with pytest.raises(InputError):
        town.reader().window(**arguments)


@pytest.mark.parametrize("city", ["elsewhere", "town"])
def test_a_city_without_generations_is_not_found(empty_town, city: str):
    with pytest.raises(NotFoundError, match=city):
        PriorReader.open(empty_town.location, city)


def test_a_generation_that_was_not_published_is_not_found(town):
    with pytest.raises(NotFoundError, match="generation 7"):
        town.reader(generation=7)


def test_a_newer_format_is_refused(town):
    edit_json(town.location / "town/city.json", lambda document: document.update(format_version="2.0"))
    with pytest.raises(StoreError, match="newer"):
        town.reader()


def test_tiles_of_two_feature_spaces_are_refused(town):
    def mix(document: dict) -> None:
        document["tiles"]["t000"]["entry"]["space_id"] = "space-2"

    file = town.location / "town/generations/00000001.json"
    edit_json(file, mix)
    file.write_bytes(encode({key: value for key, value in json.loads(file.read_text()).items() if key != "sha256"}))
    with pytest.raises(StoreError, match="different feature spaces"):
        town.reader()


def test_an_edited_generation_is_refused(town):
    edit_json(town.location / "town/generations/00000001.json", lambda document: document.update(parent=7))
    with pytest.raises(StoreError, match="seal is broken"):
        town.reader()


def test_a_generation_under_another_number_is_refused(town):
    generations = town.location / "town/generations"
    (generations / "00000002.json").write_bytes((generations / "00000001.json").read_bytes())
    with pytest.raises(StoreError, match="holds generation 1 of town"):
        town.reader()


def test_an_edited_group_document_is_refused(town):
    edit_json(town.location / "town/tiles/t000/build-1/zarr.json", lambda document: document.update(more=1))
    with pytest.raises(StoreError, match="not the document that was published"):
        town.reader().tile("t000")


def test_a_missing_tile_says_so(town):
    shutil.rmtree(town.location / "town/tiles/t000/build-1")
    with pytest.raises(StoreError, match="the tile's data is missing"):
        town.reader().window(POSES["level"])


def test_two_chunks_that_changed_places_are_an_error(empty_town, monkeypatch):
    """Both are whole, and their own checksums are right."""
    monkeypatch.setattr(schema, "CHUNK_ROWS", 64)
    publish_first(empty_town)
    folder = empty_town.location / "town/tiles/t000/build-1/hits/c"
    first, second = (folder / "0").read_bytes(), (folder / "1").read_bytes()
    (folder / "0").write_bytes(second)
    (folder / "1").write_bytes(first)
    with pytest.raises(StoreError, match="holds another chunk"):
        empty_town.reader().tile("t000").all_rows("hits")


def edit_json(file: Path, change) -> None:
    document = json.loads(file.read_text())
    change(document)
    file.write_text(json.dumps(document))


@pytest.mark.parametrize("name", [name for name in array_specs(8, 3, 32) if name != "drives"])
def test_a_flipped_bit_is_found_on_read(town, name: str):
    chunk = next(file for file in (town.location / "town/tiles/t000/build-1" / name / "c").rglob("*") if file.is_file())
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 4
    chunk.write_bytes(content)
    with pytest.raises(StoreError, match=f"{name}/c/.* is damaged"):
        town.reader().window(POSES["level"])


def test_every_array_carries_a_checksum(town):
    for name in array_specs(8, 3, 32):
        document = json.loads((town.location / "town/tiles/t000/build-1" / name / "zarr.json").read_text())
        assert document["codecs"][-1]["name"] == "crc32c"


def test_a_lost_chunk_is_an_error_and_not_an_empty_road(town):
    for chunk in (town.location / "town/tiles/t000/build-1/hits/c").iterdir():
        chunk.unlink()
    with pytest.raises(StoreError, match=r"hits/c/0 is missing"):
        town.reader().window(POSES["level"])


def test_a_pickled_reader_reads_the_same(town):
    reader = town.reader()
    expected = reader.window(POSES["level"])
    copy = pickle.loads(pickle.dumps(reader))  # noqa: S301 - our own bytes, of this moment
    assert copy.generation == reader.generation
    np.testing.assert_array_equal(copy.window(POSES["level"]).features, expected.features)


def test_a_reader_works_in_a_forked_process(town):
    reader = town.reader()
    expected = int(reader.window(POSES["level"]).hits.sum())
    context = multiprocessing.get_context("fork")
    answers = context.Queue()

    def child() -> None:
        answers.put(int(reader.window(POSES["level"]).hits.sum()))

    process = context.Process(target=child)
    process.start()
    assert answers.get(timeout=60) == expected
    process.join()


def test_a_remote_store_in_a_forked_process_is_refused_and_does_not_hang(monkeypatch):
    from presight_core.priors import location

    monkeypatch.setattr(location, "_remote_pid", [os.getpid() + 1])
    with pytest.raises(StoreError, match="spawn"):
        location.ReadLocation("s3://bucket/priors")


def test_an_unknown_kind_of_url_is_a_store_error():
    with pytest.raises(StoreError, match="nonsense"):
        PriorReader.open("nonsense://place", "town")


def hits_of(reader: PriorReader) -> int:
    return int(reader.window(POSES["level"]).hits.sum())


def test_a_reader_works_in_a_spawned_process(town):
    reader = town.reader()
    expected = hits_of(reader)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.map(hits_of, [reader, reader]) == [expected, expected]
