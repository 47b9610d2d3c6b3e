"""Everything that can happen to the bytes of a store is found, and no read is wrong without an error."""

import json
import os
import random
import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from presight_core.errors import NotFoundError, PresightError
from presight_core.priors import PriorReader, schema
from presight_core.priors.documents import encode
from presight_core.priors.example import ExampleTile
from storage.verification import verify_city

TINY = ExampleTile(side_blocks=2, voxels_per_block=12, channel_count=4, blocks_per_batch=2)


@pytest.fixture
def small(empty_town, monkeypatch):
    """A town of two generations, with several chunks in every array, about 15 kB."""
    monkeypatch.setattr(schema, "CHUNK_ROWS", 16)
    monkeypatch.setattr(schema, "BLOCK_CHUNK_ROWS", 2)
    shutil.rmtree(empty_town.location)
    store = empty_town.store
    store.create_city("town", TINY.lattice, "space-1", TINY.channel_count)
    town = replace(empty_town, example=TINY)
    store.publish("town", {"t000": town.write("t000", "build-1")}, None, town.tiling)
    other = town.write("t001", "build-1", replace(TINY, seed=1))
    store.publish("town", {"t001": other}, 1)
    store.tag("town", "release", 1)
    return town


def files(town) -> list[Path]:
    return sorted(file for file in town.location.rglob("*") if file.is_file())


def faults(town, deep: bool = True) -> list[str]:
    return [f"{fault.path}: {fault.fact}" for fault in verify_city(town.location, "town", deep).faults]


def reads_as_before(town, expected) -> bool:
    """Whether a read of everything raises an error of ours, or gives what was written; anything else fails."""
    try:
        reader = PriorReader.open(town.location, "town")
        window = reader.window(np.eye(4), (-60, 60), (-60, 60), (-90, 90))
    except PresightError:
        return True
    return reader.generation.number < 2 or all(
        np.array_equal(getattr(window, name), getattr(expected, name))
        for name in ("points_world", "features", "hits", "density", "rgb", "observed")
    )


def everything(town):
    return town.reader().window(np.eye(4), (-60, 60), (-60, 60), (-90, 90))


def test_a_sound_store_has_no_faults(small):
    result = verify_city(small.location, "town", deep=True)
    assert result.faults == []
    assert (result.generations, result.builds) == (2, 2)
    assert result.chunks > 40


def test_an_unknown_city_is_not_found(small):
    with pytest.raises(NotFoundError):
        verify_city(small.location, "elsewhere")


def flip(file: Path, place: random.Random) -> None:
    content = bytearray(file.read_bytes())
    bit = place.randrange(len(content) * 8)
    content[bit // 8] ^= 1 << bit % 8
    file.write_bytes(content)


def every_flip_is_found(town, count: int) -> None:
    """Flips in turn one bit of each file, at random places, `count` in all."""
    place, expected, every = random.Random(0), everything(town), files(town)
    for number in range(count):
        file = every[number % len(every)]
        content = file.read_bytes()
        flip(file, place)
        found, sound = faults(town), reads_as_before(town, expected)
        file.write_bytes(content)
        assert found, file
        assert sound, file
    assert faults(town) == []


def test_every_flipped_bit_is_found_and_no_read_is_wrong(small):
    every_flip_is_found(small, 20_000 if os.environ.get("PRESIGHT_TORTURE") else 500)


def test_every_missing_file_is_found_without_reading_chunks(small):
    expected = everything(small)
    for file in files(small):
        content = file.read_bytes()
        file.unlink()
        if file.name == "city.json":
            with pytest.raises(NotFoundError):
                verify_city(small.location, "town")
        elif file.name not in {"release.json", "00000002.json"}:  # whose absence is a state of its own
            assert faults(small, deep=False), file
        assert reads_as_before(small, expected), file
        file.write_bytes(content)


def test_every_truncated_file_is_found_without_reading_chunks(small):
    expected = everything(small)
    for file in files(small):
        content = file.read_bytes()
        for length in (0, 3, len(content) - 2):  # the last byte of a document is a line break, which tells nothing
            file.write_bytes(content[:length])
            assert faults(small, deep=False), file
            assert reads_as_before(small, expected), file
        file.write_bytes(content)


def test_every_pair_of_swapped_chunks_is_found_and_no_read_is_wrong(small):
    expected = everything(small)
    arrays = [array for array in small.location.glob("town/tiles/*/*/*") if array.is_dir()]
    swapped = 0
    for array in arrays:
        chunks = sorted(file for file in array.rglob("*") if file.is_file() and file.name != "zarr.json")
        for first, second in pairwise(chunks):
            contents = first.read_bytes(), second.read_bytes()
            if contents[0] == contents[1]:
                continue
            first.write_bytes(contents[1])
            second.write_bytes(contents[0])
            assert faults(small), array
            assert reads_as_before(small, expected), array
            first.write_bytes(contents[0])
            second.write_bytes(contents[1])
            swapped += 1
    assert swapped > 20


def test_a_chunk_of_another_tile_is_found(small):
    here, there = (small.location / f"town/tiles/{tile}/build-1/hits/c/0" for tile in ("t000", "t001"))
    here.write_bytes(there.read_bytes())
    assert any("hits/c/0" in fault for fault in faults(small))


def test_a_file_that_does_not_belong_is_found(small):
    (small.location / "town/tiles/t000/build-1/hits/c/99").write_bytes(b"stray")
    assert any("does not belong" in fault for fault in faults(small, deep=False))


def edited(file: Path, change) -> None:
    """Changes a document and seals it again, as somebody would who knows the format."""
    document = json.loads(file.read_text())
    document.pop("sha256")
    change(document)
    file.write_bytes(encode(document))


def test_an_edited_and_sealed_generation_is_found_by_its_child(small):
    edited(small.location / "town/generations/00000001.json", lambda document: document.update(tiling={"tiles": []}))
    assert any("is not the one that generation 2 followed" in fault for fault in faults(small, deep=False))


def test_a_generation_that_shows_another_digest_is_found(small):
    def change(document: dict) -> None:
        document["tiles"]["t001"]["entry"]["digest"] = "0" * 64

    edited(small.location / "town/generations/00000002.json", change)
    assert any("digest" in fault for fault in faults(small, deep=False))


def test_a_stale_generation_in_the_place_of_a_newer_one_is_found(small):
    generations = small.location / "town/generations"
    (generations / "00000002.json").write_bytes((generations / "00000001.json").read_bytes())
    assert any("holds generation 1" in fault for fault in faults(small, deep=False))


def test_a_generation_lost_from_the_middle_is_found_unless_older_ones_are_tagged(small):
    small.store.publish("town", {}, 2)
    (small.location / "town/generations/00000002.json").unlink()
    assert faults(small, deep=False) == []  # what gc leaves: 1 is tagged
    small.store.remove_tag("town", "release")
    assert any("00000002.json: is missing" in fault for fault in faults(small, deep=False))


def test_a_tag_of_a_generation_that_is_gone_is_found(small):
    (small.location / "town/generations/00000001.json").unlink()
    assert any("names generation 1" in fault for fault in faults(small, deep=False))
