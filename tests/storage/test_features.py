"""The feature cache: whole drives or nothing, exact values back, and damage never read as data."""

from pathlib import Path

import numpy as np
import pytest

from presight_core.drives import FrameTable, Reject
from presight_core.errors import ConflictError, InputError, NotFoundError, StoreError
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
ITEMS = [(0, layers(0)), (1, REJECT), (2, layers(2, (16, 24)))]


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


def test_an_interrupted_write_goes_on_behind_its_last_image(tmp_path):
    cache = FeatureCache(tmp_path)

    def breaking():
        yield from ITEMS[:2]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cache.write("key", "d0", FRAMES, breaking())
    assert FeatureCache(tmp_path).missing_rows("key", "d0", 3).tolist() == [2]
    assert FeatureCache(tmp_path).write("key", "d0", FRAMES, ITEMS[2:]) == (REJECT,)
    for row, written in (ITEMS[0], ITEMS[2]):
        np.testing.assert_array_equal(cache.read("key", "d0", row).features, written.features)


def test_a_line_that_a_kill_cut_short_does_not_count(tmp_path):
    cache = FeatureCache(tmp_path)
    with pytest.raises(AssertionError):
        cache.write("key", "d0", FRAMES, ITEMS[:2])
    lines = tmp_path / "key" / ".d0.jsonl"
    lines.write_bytes(lines.read_bytes()[:-5])
    assert cache.missing_rows("key", "d0", 3).tolist() == [1, 2]
    assert cache.write("key", "d0", FRAMES, ITEMS[1:]) == (REJECT,)


def test_a_damaged_line_is_damage(tmp_path):
    cache = FeatureCache(tmp_path)
    with pytest.raises(AssertionError):
        cache.write("key", "d0", FRAMES, ITEMS[:2])
    lines = tmp_path / "key" / ".d0.jsonl"
    lines.write_bytes(b"?" + lines.read_bytes())
    with pytest.raises(StoreError, match="a line cannot be read"):
        cache.missing_rows("key", "d0", 3)


def test_two_writers_of_one_drive_do_not_meet(tmp_path):
    cache = FeatureCache(tmp_path)

    def meeting():
        with pytest.raises(ConflictError, match="another process"):
            cache.write("key", "d0", FRAMES, ITEMS)
        yield from ITEMS

    cache.write("key", "d0", FRAMES, meeting())
    assert cache.is_complete("key", "d0")


def test_too_few_items_are_our_own_mistake(tmp_path):
    cache = FeatureCache(tmp_path)
    with pytest.raises(AssertionError, match="2 items for 3 frames"):
        cache.write("key", "d0", FRAMES, ITEMS[:2])
    assert not cache.is_complete("key", "d0")


def test_compact_features_come_back_about_as_they_were(tmp_path):
    cache = FeatureCache(tmp_path)
    features = smooth_features()
    cache.write("key", "d0", frames_of(["a.jpg"]), [(0, FrameLayers(np.zeros((4, 4), np.uint8), features))], np.ones(5))
    read = FeatureCache(tmp_path).read("key", "d0", 0).features
    assert 0 < np.abs(read.astype(int) - features).mean() < 4
    assert cache.figures("key", "d0")["feature_bytes"] < features.size / 4


def smooth_features() -> np.ndarray:
    row, column, channel = np.meshgrid(np.arange(16), np.arange(24), np.arange(5), indexing="ij")
    return (128 + 100 * np.sin(row / 5 + channel) * np.cos(column / 7)).astype(np.uint8)


@pytest.mark.parametrize("place", [0, 30])
def test_a_flipped_bit_in_compact_features_is_damage(tmp_path, place):
    cache = FeatureCache(tmp_path)
    layers_ = FrameLayers(np.zeros((4, 4), np.uint8), smooth_features())
    cache.write("key", "d0", frames_of(["a.jpg"]), [(0, layers_)], np.ones(5))
    (chunk,) = (file for file in (tmp_path / "key" / "d0" / "features" / "c").rglob("*") if file.is_file())
    content = bytearray(chunk.read_bytes())
    content[place] ^= 1
    chunk.write_bytes(content)
    with pytest.raises(StoreError, match="delete this, and the next build"):
        cache.read("key", "d0", 0)


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
    with pytest.raises(StoreError, match="delete this, and the next build"):
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
