"""Cached pixels: the right image, labels and features for every row, from several threads."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from presight_core.config import CitySettings, TrainingSettings
from presight_core.drives import FrameTable
from presight_core.errors import InputError, NotFoundError
from presight_core.pixels import FrameLayers
from storage.features import FeatureCache
from storage.pixels import CachedPixels

COUNT, WIDTH_PX, HEIGHT_PX = 6, 40, 20


@pytest.fixture
def frames() -> FrameTable:
    return FrameTable(
        drive_id=np.full(COUNT, "d0"),
        camera=np.full(COUNT, "CAM_FRONT"),
        timestamp_us=np.arange(COUNT),
        path=np.array([f"{i}.jpg" for i in range(COUNT)]),
        file_bytes=np.zeros(COUNT, np.int64),
        width_px=np.full(COUNT, WIDTH_PX, np.int32),
        height_px=np.full(COUNT, HEIGHT_PX, np.int32),
        intrinsics=np.tile(np.eye(3), (COUNT, 1, 1)),
        world_from_camera=np.tile(np.eye(4), (COUNT, 1, 1)),
        is_keyframe=np.ones(COUNT, np.bool_),
    )


@pytest.fixture
def cache(tmp_path, frames) -> FeatureCache:
    """Frame i is an image of blue 40 i, with label i and features i."""
    items = []
    for i in range(COUNT):
        cv2.imwrite(str(tmp_path / f"{i}.jpg"), np.full((HEIGHT_PX, WIDTH_PX, 3), (40 * i, 0, 0), np.uint8))
        items.append((i, FrameLayers(np.full((10, 20), i, np.uint8), np.full((5, 10, 3), i, np.uint8))))
    cache = FeatureCache(tmp_path / "cache")
    cache.write("key", "d0", frames, items)
    return cache


def pixels_of(frames: FrameTable, root: Path, cache: FeatureCache, scale: float = 1.0) -> CachedPixels:
    settings = CitySettings(training=TrainingSettings(image_scale=scale))
    return CachedPixels(frames, {"d0": root}, cache, "key", settings)


def test_a_choice_of_frames_keeps_each_frames_own_layers(frames, cache, tmp_path):
    chosen = np.array([4, 1])
    source = pixels_of(frames.select(chosen), tmp_path, cache)
    for row, frame in enumerate(chosen):
        pixels = source.load(row)
        assert abs(int(pixels.rgb[0, 0, 2]) - 40 * frame) <= 2  # JPEG rounds
        assert pixels.labels.max() == frame
        assert pixels.features.max() == frame


def test_views_are_what_is_loaded_without_features(frames, cache, tmp_path):
    source = pixels_of(frames, tmp_path, cache)
    rgb, labels = source.load_view(3)
    np.testing.assert_array_equal(rgb, source.load(3).rgb)
    np.testing.assert_array_equal(labels, source.load(3).labels)


def test_images_shrink_to_the_scale_and_layers_do_not(frames, cache, tmp_path):
    pixels = pixels_of(frames, tmp_path, cache, 0.5).load(0)
    assert pixels.rgb.shape == (10, 20, 3)
    assert pixels.labels.shape == (10, 20)
    assert pixels.features.shape == (5, 10, 3)


def test_threads_get_what_one_thread_gets(frames, cache, tmp_path):
    source = pixels_of(frames, tmp_path, cache)
    rows = list(range(COUNT)) * 5
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(source.load, rows))
    for row, pixels in zip(rows, together, strict=True):
        np.testing.assert_array_equal(pixels.rgb, source.load(row).rgb)
        assert pixels.features.max() == row


def test_an_exif_rotation_is_ignored(frames, cache, tmp_path):
    from PIL import Image

    wide = Image.new("RGB", (WIDTH_PX, HEIGHT_PX), "white")
    exif = wide.getexif()
    exif[0x0112] = 6  # orientation: turn by 90 degrees to view
    wide.save(tmp_path / "0.jpg", exif=exif)
    assert pixels_of(frames, tmp_path, cache).load(0).rgb.shape == (HEIGHT_PX, WIDTH_PX, 3)


def test_a_vanished_image_is_named(frames, cache, tmp_path):
    (tmp_path / "3.jpg").unlink()
    with pytest.raises(InputError, match=r"3\.jpg: cannot be read"):
        pixels_of(frames, tmp_path, cache).load(3)


def test_frames_without_features_are_refused_at_once(frames, cache, tmp_path):
    renamed = replace(frames, path=np.array([f"new{i}.jpg" for i in range(COUNT)]))
    with pytest.raises(NotFoundError, match=r"new0\.jpg: not in the features"):
        pixels_of(renamed, tmp_path, cache)
