"""Pictures: colours mean what they say, sizes fit, and a file is whole or absent."""

import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from presight_core import classes
from presight_core.pictures import depth_image, feature_image, label_image, overlay, resize, save_png, stack_rows

GREY = np.full((10, 20, 3), 90, np.uint8)


def test_near_is_red_far_is_blue_and_sky_is_black():
    near, far, *nothing = depth_image([[1.5, 60.0, 0.0, np.nan, np.inf]])[0].astype(int)
    assert near[0] > near[2]
    assert far[2] > far[0]
    assert not np.any(nothing)


def test_depths_beyond_the_scale_saturate():
    pixels = depth_image([[80.0, 500.0, 1.0, 0.2]])[0]
    np.testing.assert_array_equal(pixels[0], pixels[1])
    np.testing.assert_array_equal(pixels[2], pixels[3])


def test_labels_have_the_cityscapes_colours_and_unknown_is_black():
    picture = label_image(np.array([[0, 18, 255, 30]]))
    np.testing.assert_array_equal(picture[0, :2], np.array(classes.COLOURS)[[0, 18]])
    assert picture[0, 2:].max() == 0


def test_features_of_both_types_look_the_same():
    features = np.random.default_rng(0).integers(0, 256, (4, 5, 8), np.uint8)
    np.testing.assert_array_equal(feature_image(features), features[..., :3])
    np.testing.assert_array_equal(feature_image(features / np.float32(255)), features[..., :3])


def test_a_single_channel_is_grey():
    assert np.ptp(feature_image(np.full((2, 2, 1), 7, np.uint8)), axis=-1).max() == 0


def test_a_mask_of_another_resolution_tints_the_pixels_it_covers():
    mask = np.array([[True, False]])
    tinted = overlay(GREY, mask, (255, 0, 0), opacity=1.0)
    assert np.all(tinted[:, :10] == [255, 0, 0])
    np.testing.assert_array_equal(tinted[:, 10:], GREY[:, 10:])


def test_images_of_a_row_get_one_height_and_keep_their_shape():
    small = np.zeros((5, 20, 3), np.uint8)
    picture = stack_rows([[GREY, small]])
    assert picture.shape == (10, 20 + 4 + 40, 3)


def test_rows_of_different_widths_are_padded_with_white():
    picture = stack_rows([[GREY, GREY], [GREY]])
    assert picture.shape == (10 + 4 + 10, 44, 3)
    assert np.all(picture[14:, 24:] == 255)


def test_titles_stand_above_their_columns():
    titled = stack_rows([[GREY, GREY]], ["left", "right"])
    plain = stack_rows([[GREY, GREY]])
    np.testing.assert_array_equal(titled[-10:], plain)
    strip = titled[: len(titled) - 10]
    assert strip[:, :20].min() < 128
    assert strip[:, 24:].min() < 128


def test_small_grids_grow_without_blur():
    grid = np.random.default_rng(0).integers(0, 256, (2, 3, 3), np.uint8)
    np.testing.assert_array_equal(resize(grid, 12, 8), grid.repeat(4, 0).repeat(4, 1))


def test_a_saved_picture_comes_back(tmp_path):
    file = tmp_path / "new" / "grey.png"
    save_png(file, GREY)
    np.testing.assert_array_equal(np.asarray(Image.open(file)), GREY)
    assert [path.name for path in file.parent.iterdir()] == ["grey.png"]


def test_a_picture_that_cannot_be_saved_leaves_the_old_one(tmp_path):
    file = tmp_path / "grey.png"
    save_png(file, GREY)
    with pytest.raises((TypeError, ValueError)):
        save_png(file, np.zeros((2, 2, 7), np.uint8))
    np.testing.assert_array_equal(np.asarray(Image.open(file)), GREY)


def test_importing_pictures_and_maps_loads_no_drawing_library():
    code = (
        "import sys, presight_core.pictures, presight_core.maps;"
        "print([name for name in ('torch', 'matplotlib', 'PIL', 'cv2') if name in sys.modules])"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "[]"
