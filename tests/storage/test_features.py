"""The feature cache: whole drives or nothing, exact values back, and damage never read as data."""

from pathlib import Path

import numpy as np
import pytest

from presight_core.drives import FrameTable, Reject
from presight_core.errors import InputError, NotFoundError, StoreError
from presight_core.pixels import FrameLayers
from storage.features import FeatureCache

REJECT = Reject("image-broken", "b.jpg", "0 bytes that do not decode as an image", "copy it again", "scene-1")


def frames_of(paths: list[str]) -> FrameTable:
    count = len(paths)
    return FrameTable(
        drive_id=np.full(count, "d0"),
        camera=np.full(count, "CAM_FRONT"),
        timestamp_us=np.arange(count),
        path=np.array(paths),
        file_bytes=np.zeros(count, np.int64),
        width_px=np.full(count, 96, np.int32),
        height_px=np.full(count, 64, np.int32),
        intrinsics=np.tile(np.eye(3), (count, 1, 1)),
        world_from_camera=np.tile(np.eye(4), (count, 1, 1)),
        is_keyframe=np.ones(count, np.bool_),
    )


def layers(seed: int, label_shape: tuple[int, int] = (32, 48)) -> FrameLayers:
    generator = np.random.default_rng(seed)
    return FrameLayers(
        generator.integers(0, 19, label_shape, np.uint8), generator.integers(0, 256, (8, 12, 5), np.uint8)
    )


FRAMES = frames_of(["a.jpg", "b.jpg", "c.jpg"])
ITEMS = [(0, layers(0)), REJECT, (2, layers(2, (16, 24)))]


@pytest.fixture
def cache(tmp_path: Path) -> FeatureCache:
    cache = FeatureCache(tmp_path)
    cache.write("key", "d0", FRAMES, ITEMS)
    return cache


def test_layers_come_back_as_they_were_written(cache):
    for row, written in (ITEMS[0], ITEMS[2]):
        read = cache.read("key", "d0", row)
        np.testing.assert_array_equal(read.labels, written.labels)
        np.testing.assert_array_equal(read.features, written.features)


def test_a_rejected_image_says_why_when_it_is_read(cache):
    with pytest.raises(InputError, match=r"b\.jpg: 0 bytes .*; copy it again"):
        cache.read("key", "d0", 1)
    assert cache.rejects("key", "d0") == {1: REJECT}


def test_writing_returns_the_rejects(tmp_path):
    assert FeatureCache(tmp_path).write("key", "d0", FRAMES, ITEMS) == (REJECT,)


def test_black_layers_are_data_not_absence(tmp_path):
    black = FrameLayers(np.zeros((4, 4), np.uint8), np.zeros((2, 2, 3), np.uint8))
    cache = FeatureCache(tmp_path)
    cache.write("key", "d0", frames_of(["a.jpg"]), [(0, black)])
    assert cache.read("key", "d0", 0).features.max() == 0


def test_a_drive_is_complete_only_when_all_of_it_is_there(tmp_path):
    cache = FeatureCache(tmp_path)

    def breaking():
        yield ITEMS[0]
        assert not cache.is_complete("key", "d0")
        raise InputError("the disk of the images is gone")

    with pytest.raises(InputError, match="gone"):
        cache.write("key", "d0", FRAMES, breaking())
    assert not cache.is_complete("key", "d0")
    assert list((tmp_path / "key").iterdir()) == []


def test_too_few_items_are_our_own_mistake_and_leave_nothing(tmp_path):
    cache = FeatureCache(tmp_path)
    with pytest.raises(AssertionError, match="2 items for 3 frames"):
        cache.write("key", "d0", FRAMES, ITEMS[:2])
    assert not cache.is_complete("key", "d0")


def test_a_second_write_keeps_the_first(cache):
    cache.write("key", "d0", FRAMES, [(row, layers(9)) for row in range(3)])
    np.testing.assert_array_equal(cache.read("key", "d0", 0).features, ITEMS[0][1].features)


def test_other_recipes_and_drives_are_not_there(cache):
    assert cache.is_complete("key", "d0")
    assert not cache.is_complete("other", "d0")
    with pytest.raises(NotFoundError, match="no features of drive d1"):
        cache.read("key", "d1", 0)


def test_an_empty_drive_is_complete(tmp_path):
    cache = FeatureCache(tmp_path)
    cache.write("key", "d0", frames_of([]), [])
    assert cache.is_complete("key", "d0")
    assert cache.rows_of("key", "d0") == {}


@pytest.mark.parametrize("array", ["features", "labels_32x48"])
def test_a_flipped_bit_is_damage(cache, tmp_path, array):
    (chunk,) = (file for file in (tmp_path / "key" / "d0" / array / "c" / "0").rglob("*") if file.is_file())
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)
    with pytest.raises(StoreError, match="delete this folder"):
        cache.read("key", "d0", 0)


def test_a_lost_chunk_is_damage(cache, tmp_path):
    (chunk,) = (file for file in (tmp_path / "key" / "d0" / "features" / "c" / "2").rglob("*") if file.is_file())
    chunk.unlink()
    with pytest.raises(StoreError, match="1 chunks of features, expected 2"):
        cache.read("key", "d0", 0)


def test_unreadable_documents_are_damage(cache, tmp_path):
    (tmp_path / "key" / "d0" / "zarr.json").write_text("{")
    with pytest.raises(StoreError, match="documents cannot be read"):
        cache.read("key", "d0", 0)
