"""The stored bytes, read as docs/prior-format.md tells, without this project's reader: without Zarr, and with it."""

import hashlib
import json
import math
from pathlib import Path

import numpy as np
import pytest
import zarr
from numcodecs import Blosc, Zstd

from presight_core.priors.schema import array_specs

CHECKSUM_BYTES = 4


def plain_array(folder: Path) -> np.ndarray:
    """A whole array, chunk by chunk."""
    document = json.loads((folder / "zarr.json").read_text())
    shape, chunk = document["shape"], document["chunk_grid"]["configuration"]["chunk_shape"]
    assert shape[1:] == chunk[1:], "arrays are cut along their rows only"
    first, compressor, last = [codec["name"] for codec in document["codecs"]]
    assert (first, last) == ("bytes", "crc32c")
    parts = []
    for number in range(math.ceil(shape[0] / chunk[0])):
        content = (folder / "c" / "/".join([str(number)] + ["0"] * (len(shape) - 1))).read_bytes()
        part = {"blosc": Blosc(), "zstd": Zstd()}[compressor].decode(content[:-CHECKSUM_BYTES])
        parts.append(np.frombuffer(part, np.dtype(document["data_type"]).newbyteorder("<")).reshape(chunk))
    return np.concatenate(parts)[: shape[0]]


def morton_key(x: int, y: int) -> int:
    bits = zip(*(reversed(f"{value + 2**31:032b}") for value in (x, y)), strict=True)
    return sum((int(of_x) << 2 * place) + (int(of_y) << 2 * place + 1) for place, (of_x, of_y) in enumerate(bits))


def newest_tile(store: Path) -> tuple[dict, dict, Path]:
    city = json.loads((store / "town/city.json").read_text())
    newest = sorted((store / "town/generations").iterdir())[-1]
    entry = json.loads(newest.read_text())["tiles"]["t000"]["entry"]
    return city, entry, store / "town" / entry["path"]


def test_positions_follow_the_documented_formula(town):
    city, entry, folder = newest_tile(town.location)
    starts, blocks = plain_array(folder / "block_start"), plain_array(folder / "block_index").tolist()
    voxels, centroids = plain_array(folder / "voxel").tolist(), plain_array(folder / "centroid")
    keys = [morton_key(x, y) for x, y in blocks]
    assert keys == sorted(set(keys))
    side, points = city["lattice"]["block_columns"], []
    for (x, y), first, last in zip(blocks, starts[:-1], starts[1:], strict=True):
        for row in range(first, last):
            word = voxels[row]
            index = np.array([x * side + (word >> 24), y * side + (word >> 16 & 255), (word & 65535) - 32768])
            points.append(city["lattice"]["voxel_m"] * (index + (centroids[row] + 0.5) / 256))
    assert len(points) == entry["voxel_count"]
    window = town.reader().window(np.eye(4), (-100, 100), (-100, 100), (-100, 100))
    np.testing.assert_allclose(np.array(points), window.points_world, atol=1e-9)
    np.testing.assert_array_equal(plain_array(folder / "features") * city["feature_step"], window.features)


def test_observed_bits_are_where_the_page_says(town):
    _, _, folder = newest_tile(town.location)
    bits = plain_array(folder / "observed")
    window = town.reader().window(np.eye(4), (-100, 100), (-100, 100), (-100, 100))
    for number, (block_x, block_y) in enumerate(plain_array(folder / "block_index").tolist()):
        for x, y in [(0, 0), (31, 31), (5, 11)]:
            place = np.array([block_x * 32 + x, block_y * 32 + y]) - window.observed_origin
            assert window.observed[tuple(place)] == bool(bits[number, x, y // 8] >> (y % 8) & 1)


def test_the_digest_can_be_computed_from_the_contents(town):
    _, entry, folder = newest_tile(town.location)
    arrays = {}
    for array in (path for path in folder.iterdir() if path.is_dir()):
        content = plain_array(array)
        sha256 = hashlib.sha256(content.tobytes()).hexdigest()
        arrays[array.name] = {"dtype": str(content.dtype), "shape": list(content.shape), "sha256": sha256}
    text = json.dumps(arrays, sort_keys=True, separators=(",", ":"))
    assert hashlib.sha256(text.encode()).hexdigest() == entry["digest"]


@pytest.mark.parametrize("name", array_specs(8, 3, 32))
def test_a_zarr_library_reads_the_same_arrays(town, name: str):
    _, _, folder = newest_tile(town.location)
    found = np.asarray(zarr.open_group(folder, mode="r")[name])
    np.testing.assert_array_equal(found, plain_array(folder / name))


def test_the_seal_can_be_computed_from_the_document(town):
    for file in [town.location / "town/city.json", town.location / "town/generations/00000001.json"]:
        document = json.loads(file.read_text())
        seal = document.pop("sha256")
        text = json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
        assert hashlib.sha256(text.encode()).hexdigest() == seal


def test_a_generation_names_the_bytes_of_its_parent_and_of_its_tiles(town):
    town.store.publish("town", {"t001": town.write("t001", "build-1")}, 1)
    first = (town.location / "town/generations/00000001.json").read_bytes()
    second = json.loads((town.location / "town/generations/00000002.json").read_text())
    assert second["parent_sha256"] == hashlib.sha256(first).hexdigest()
    for tile in second["tiles"].values():
        group = (town.location / "town" / tile["entry"]["path"] / "zarr.json").read_bytes()
        assert tile["entry"]["group_sha256"] == hashlib.sha256(group).hexdigest()
