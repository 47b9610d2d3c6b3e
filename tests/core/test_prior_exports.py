"""Priors on their way out of the store, and back in from the released pickles."""

import json
import os
import warnings
from pathlib import Path
from pickle import Unpickler, dumps
from pickletools import genops

import numpy as np
import pytest

from presight_core.errors import InputError
from presight_core.grid import Lattice
from presight_core.priors import PriorReader
from presight_core.priors.documents import GenerationTile
from presight_core.priors.example import ExampleTile
from presight_core.priors.exports import write_npy, write_ply, write_stac
from presight_core.priors.legacy import ALLOWED, LegacyTile, legacy_batches, read_legacy, write_legacy
from presight_core.priors.schema import array_specs, check_batch, unpack_columns
from storage.priors import PriorStore
from storage.tile_groups import TileName

EXAMPLE = ExampleTile(side_blocks=2)
WIDE = {"x_m": (-200.0, 200.0), "y_m": (-200.0, 200.0), "z_m": (-90.0, 90.0)}


class Shifted(ExampleTile):
    """The example a few blocks further east."""

    @property
    def blocks(self):
        return super().blocks + np.array([4, 0], np.int32)


def city(location: Path, name: str = "town") -> PriorReader:
    """A city of two tiles side by side."""
    store = PriorStore.open(location)
    store.create_city(name, EXAMPLE.lattice, "space-1", EXAMPLE.channel_count)
    tiles = {}
    for tile_id, example in {"t000": EXAMPLE, "t001": Shifted(side_blocks=2, seed=1)}.items():
        entry = store.write_tile(name, TileName(tile_id, "build"), example.batches(), ["a", "b", "c"], {})
        tiles[tile_id] = GenerationTile(entry, {})
    centroids = {"t000": [0.0, 0.0], "t001": [51.2, 0.0]}
    registry = [{"tile_id": tile_id, "centroid_m": centroid} for tile_id, centroid in centroids.items()]
    store.publish(name, tiles, None, {"tiling_id": "one", "city": name, "tiles": registry})
    return PriorReader.open(location, name)


def released_rows(files: list[Path]) -> dict[str, np.ndarray]:
    """What the released loader makes of its pickles: origin added, x and y negated, tiles one after the other."""
    parts = []
    for file in files:
        with file.open("rb") as opened, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy 2 says that numpy.core has moved
            part = Unpickler(opened).load()  # noqa: S301 - our own bytes, of this moment
        assert {name: (array.dtype.str, array.ndim) for name, array in part.items()} == {
            "points": ("<f4", 2),
            "features": ("<f2", 2),
            "colors": ("<f4", 2),
            "hits": ("<i8", 1),
            "origin": ("<f4", 1),
        }
        parts.append({**part, "points": (part["points"] + part["origin"]) * np.array([-1, -1, 1], np.float32)})
    return {name: np.concatenate([part[name] for part in parts]) for name in ("points", "features", "hits", "colors")}


def test_the_released_loader_finds_the_voxels_where_they_are(tmp_path: Path):
    reader = city(tmp_path / "store")
    files = write_legacy(reader, tmp_path)
    assert [file.name for file in files] == ["town-c0.pkl", "town-c1.pkl"]
    rows, window = released_rows(files), reader.window(np.eye(4), **WIDE)
    np.testing.assert_allclose(rows["points"], window.points_world, atol=1e-4)
    np.testing.assert_allclose(rows["features"], window.features / 255, atol=5e-4)
    np.testing.assert_array_equal(rows["hits"], window.hits)
    np.testing.assert_allclose(rows["colors"], window.rgb / 255, atol=1e-6)


def test_a_city_of_the_paper_has_as_many_pickles_as_the_configurations_read(tmp_path: Path):
    reader = city(tmp_path / "store", "singapore-onenorth")
    files = write_legacy(reader, tmp_path)
    assert [file.name for file in files] == [f"singapore-onenorth-c{number}.pkl" for number in range(4)]
    window = reader.window(np.eye(4), **WIDE)
    np.testing.assert_array_equal(released_rows(files)["hits"], window.hits)


def test_pickles_ask_for_nothing_that_python_38_and_numpy_119_have_not(tmp_path: Path):
    asked: set[tuple[str, str]] = set()

    class Asking(Unpickler):
        def find_class(self, module: str, name: str):
            asked.add((module, name))
            return ALLOWED[module, name]

    for file in write_legacy(city(tmp_path / "store"), tmp_path):
        operations = list(genops(file.read_bytes()))
        assert operations[0][1] == 4, "the protocol that the file says"
        assert max(operation.proto for operation, _, _ in operations) <= 4
        with file.open("rb") as opened:
            Asking(opened).load()
    assert asked == {("numpy.core.multiarray", "_reconstruct"), ("numpy", "ndarray"), ("numpy", "dtype")}


def test_what_was_exported_reads_back_through_the_restricted_reader(tmp_path: Path):
    reader = city(tmp_path / "store")
    tiles = [read_legacy(file) for file in write_legacy(reader, tmp_path)]
    np.testing.assert_allclose(
        np.concatenate([tile.points_world for tile in tiles]), reader.window(np.eye(4), **WIDE).points_world, atol=1e-4
    )


class Bomb:
    def __reduce__(self):
        return os.system, ("touch /tmp/should-not-be-there",)


ARRAYS = {
    "points": np.zeros((2, 3), np.float32),
    "features": np.zeros((2, 4), np.float16),
    "hits": np.ones(2, np.int64),
    "colors": np.zeros((2, 3), np.float32),
    "origin": np.zeros(3, np.float32),
}


@pytest.mark.parametrize(
    "content",
    [
        dumps(Bomb()),
        dumps({**ARRAYS, "points": Bomb()}),
        dumps({**ARRAYS, "more": np.array([Bomb()], object)}),
        dumps({**ARRAYS, "hits": np.array([1, 2], object)}),
        dumps({**ARRAYS, "hits": np.ones(3, np.int64)}),
        dumps({**ARRAYS, "hits": np.zeros(2, np.int64)}),
        dumps({**ARRAYS, "points": np.full((2, 3), np.nan, np.float32)}),
        dumps({**ARRAYS, "points": [[0, 0, 0], [1, 1, 1]]}),
        dumps({name: array for name, array in ARRAYS.items() if name != "origin"}),
        dumps(list(ARRAYS.values())),
        dumps(ARRAYS)[:-20],
        b"",
        b"cbuiltins\neval\n(S'1'\ntR.",
        b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(L1000000000000000L\ntc__builtin__\nbytes\ntR.",
    ],
)
def test_anything_but_arrays_is_refused_and_nothing_is_executed(tmp_path: Path, monkeypatch, content: bytes):
    monkeypatch.setattr(os, "system", lambda command: pytest.fail(f"executed {command}"))
    file = tmp_path / "town-c0.pkl"
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"town-c0\.pkl"):
        read_legacy(file)


@pytest.mark.parametrize("protocol", [3, 4, 5])
def test_pickles_of_all_protocols_with_an_origin_of_either_shape_are_read(tmp_path: Path, protocol: int):
    file = tmp_path / "town-c0.pkl"
    file.write_bytes(dumps({**ARRAYS, "origin": np.array([[1.0, 2.0, 3.0]], np.float32)}, protocol))
    np.testing.assert_array_equal(read_legacy(file).points_world, [[-1, -2, 3], [-1, -2, 3]])


def random_tile(count: int, seed: int, east_m: float) -> LegacyTile:
    random = np.random.default_rng(seed)
    points = random.uniform([-20, -20, -2], [20, 20, 4], (count, 3)) + np.array([east_m, 0, 0])
    features = random.random((count, 5)).astype(np.float16)
    return LegacyTile(points, features, random.integers(1, 20, count), random.random((count, 3)).astype(np.float32))


def test_imported_voxels_are_the_weighted_means_of_those_that_meet():
    """A slow twin with a dictionary, over two tiles that overlap."""
    lattice, tiles = Lattice(), [random_tile(4000, 0, 0.0), random_tile(4000, 1, 25.0)]
    sums: dict[tuple, list] = {}
    for tile in tiles:
        for point, feature, hit in zip(tile.points_world, tile.features, tile.hits, strict=True):
            row = sums.setdefault(tuple(lattice.voxel_of(point[None])[0].tolist()), [0, np.zeros(5), np.zeros(3)])
            row[0] += hit
            row[1] += feature.astype(float) * hit
            row[2] += point * hit
    assert len(sums) < 8000  # some did meet
    found = {}
    specs = array_specs(5, 1, 32)
    for batches in legacy_batches(tiles, lattice):
        for batch in batches:
            check_batch(batch, specs)
            blocks = np.repeat(batch.block_index, np.diff(batch.block_start), axis=0)
            for word, (x, y), feature, hit, centroid in zip(
                batch.voxel.tolist(), blocks.tolist(), batch.features, batch.hits, batch.centroid, strict=True
            ):
                place = (x * 32 + (word >> 24), y * 32 + (word >> 16 & 255), (word & 65535) - 32768)
                assert place not in found, "a voxel is stored once"
                found[place] = (hit, feature, centroid)
            assert unpack_columns(batch.observed).sum() == len(
                {(x, y, word >> 16) for (x, y), word in zip(blocks.tolist(), batch.voxel.tolist(), strict=True)}
            )
    assert found.keys() == sums.keys()
    for place, (hit, feature, centroid) in found.items():
        total, features, points = sums[place]
        assert hit == total
        np.testing.assert_allclose(feature, features / total * 255, atol=0.51)
        np.testing.assert_allclose((centroid + 0.5) / 256, (points / total) / 0.4 - place, atol=0.6 / 256)


def test_mapped_blocks_hold_every_voxel_in_morton_order(tmp_path: Path):
    reader = city(tmp_path / "store")
    write_npy(reader, tmp_path)
    columns = {file.stem: np.load(file, mmap_mode="r") for file in tmp_path.glob("*.npy")}
    layout, window = json.loads((tmp_path / "layout.json").read_text()), reader.window(np.eye(4), **WIDE)
    points = columns["points"] + np.array(layout["origin_m"])
    order, expected = (np.lexsort(array.T) for array in (np.round(points, 3), np.round(window.points_world, 3)))
    np.testing.assert_allclose(points[order], window.points_world[expected], atol=1e-3)
    np.testing.assert_array_equal(columns["features"][order], window.features[expected])
    np.testing.assert_array_equal(columns["hits"][order], window.hits[expected])
    blocks = np.repeat(columns["block_index"], np.diff(columns["block_start"]), axis=0)
    np.testing.assert_array_equal(np.floor(points[:, :2] / 12.8), blocks)
    assert layout["voxel_count"] == len(window)
    assert columns["observed"].shape == (len(columns["block_index"]), 32, 4)


def test_an_empty_city_can_be_mapped(tmp_path: Path):
    store = PriorStore.open(tmp_path / "store")
    store.create_city("town", Lattice(), "space-1", 8)
    entry = store.write_tile("town", TileName("t000", "build"), [], ["a"], {})
    tiling = {"tiling_id": "one", "city": "town", "tiles": [{"tile_id": "t000", "centroid_m": [0.0, 0.0]}]}
    store.publish("town", {"t000": GenerationTile(entry, {})}, None, tiling)
    write_npy(PriorReader.open(tmp_path / "store", "town"), tmp_path)
    assert np.load(tmp_path / "features.npy").shape == (0, 8)


def test_a_point_cloud_holds_every_voxel(tmp_path: Path):
    reader = city(tmp_path / "store")
    write_ply(reader, tmp_path)
    head, _, body = (tmp_path / "town.ply").read_bytes().partition(b"end_header\n")
    assert head.startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 300\nproperty double x\n")
    kinds = [("xyz", "<f8", 3), ("rgb", "u1", 3), ("hits", "<u4")]
    vertices = np.frombuffer(body, np.dtype(kinds))
    window = reader.window(np.eye(4), **WIDE)
    np.testing.assert_allclose(vertices["xyz"], window.points_world, atol=1e-9)
    np.testing.assert_array_equal(vertices["rgb"], window.rgb)
    np.testing.assert_array_equal(vertices["hits"], window.hits)


@pytest.mark.parametrize("name", ["town", "singapore-onenorth"])
def test_a_stac_catalog_is_valid(tmp_path: Path, name: str):
    pystac = pytest.importorskip("pystac")
    write_stac(city(tmp_path / "store", name), tmp_path, "file:///maps", "2026-11-22T10:00:00Z")
    catalog = pystac.Catalog.from_file(str(tmp_path / "catalog.json"))
    assert catalog.validate_all() == 2  # items, after all catalogs above them
    items = list(catalog.get_items(recursive=True))
    assert [item.id for item in items] == [f"{name}-t000", f"{name}-t001"]
    assert items[0].assets["voxels"].href == f"file:///maps/{name}/tiles/t000/build"
    assert (items[0].bbox is not None) == (name != "town")


def test_a_tile_of_a_known_city_lies_where_the_city_does(tmp_path: Path):
    write_stac(city(tmp_path / "store", "singapore-onenorth"), tmp_path, "file:///maps", "2026-11-22T10:00:00Z")
    west, south, east, north = json.loads((tmp_path / "singapore-onenorth-t000.json").read_text())["bbox"]
    metres = 6_378_137.0 * np.deg2rad(1.0)
    assert (north - south) * metres == pytest.approx(25.6, rel=1e-3)
    assert (east - west) * metres * np.cos(np.deg2rad(1.29)) == pytest.approx(25.6, rel=1e-3)
    assert (west + east) / 2 == pytest.approx(103.7848, abs=1e-3)
