"""Maps: north is up, the highest wins, and tiles are where they are."""

from dataclasses import replace

import numpy as np
import pytest

from presight_core import frames
from presight_core.maps import BACKGROUND, LEGEND_PX, MapView, birds_eye, prior_picture, tile_map
from presight_core.priors.window import Window
from presight_core.tiles import SubField, Tile, Tiling

RED, GREEN = (255, 0, 0), (0, 255, 0)
VIEW = MapView(x_m=(0, 20), y_m=(0, 10), pixel_m=1.0)


def drawn(picture: np.ndarray) -> np.ndarray:
    """The panel without its legend."""
    return picture[:-LEGEND_PX]


def test_x_points_right_and_y_points_up():
    picture = drawn(birds_eye([[18.5, 8.5, 0]], [RED], VIEW, point_m=1.0))
    assert picture.shape == (10, 20, 3)
    rows, columns = np.nonzero(np.any(picture != BACKGROUND, -1))
    assert (rows.tolist(), columns.tolist()) == ([1], [18])


@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_the_highest_point_of_a_place_is_seen(order):
    points = np.array([[5.5, 5.5, 3.0], [5.5, 5.5, 1.0]])[order]
    colours = np.array([RED, GREEN])[order]
    assert drawn(birds_eye(points, colours, VIEW, 1.0))[4, 5].tolist() == list(RED)


def test_a_point_covers_its_size():
    picture = drawn(birds_eye([[10.5, 5.5, 0]], [RED], VIEW, point_m=3.0))
    rows, columns = np.nonzero(np.any(picture != BACKGROUND, -1))
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (3, 5, 9, 11)


def test_points_outside_the_view_are_left_out():
    picture = drawn(birds_eye([[-3, 5, 0], [25, 5, 0], [5, 30, 0]], [RED] * 3, VIEW, 1.0))
    assert np.all(picture == BACKGROUND)


def window_of(points_ego: np.ndarray, world_from_ego: np.ndarray) -> Window:
    count = len(points_ego)
    return Window(
        points_ego=points_ego.astype(np.float32),
        points_world=frames.apply(world_from_ego, points_ego),
        features=np.zeros((count, 4), np.uint8),
        hits=np.ones(count, np.uint32),
        density=np.ones(count, np.float16),
        rgb=np.full((count, 3), 10, np.uint8),
        observed=np.ones((1, 1), np.bool_),
        observed_origin=(0, 0),
        coverage=1.0,
        tiles=("t000",),
    )


def test_a_prior_is_drawn_as_three_panels_side_by_side():
    points = np.random.default_rng(0).uniform(-5, 5, (200, 3))
    picture = prior_picture(window_of(points, np.eye(4)), (-5, 5), (-5, 5), voxel_m=0.4)
    panel = round(10 / 0.2)  # two pixels a voxel
    assert picture.shape[0] > panel
    assert picture.shape[1] == pytest.approx(3 * panel, abs=10)


def test_turning_the_vehicle_turns_the_north_arrow_and_nothing_else():
    points = np.random.default_rng(0).uniform(-5, 5, (200, 3))
    pictures = [
        prior_picture(window_of(points, frames.planar_transform(0, 0, yaw)), (-5, 5), (-5, 5), 0.4)
        for yaw in (0.0, np.pi / 2)
    ]
    np.testing.assert_array_equal(*[picture[:-LEGEND_PX] for picture in pictures])
    assert np.any(pictures[0][-LEGEND_PX:] != pictures[1][-LEGEND_PX:])


def test_an_empty_prior_is_drawn_empty():
    picture = prior_picture(window_of(np.zeros((0, 3)), np.eye(4)), (-5, 5), (-5, 5), 0.4)
    assert picture.size > 0


def test_a_tile_map_shows_every_tiles_colour():
    tiling = Tiling("id", "town", (Tile("t000", (0, 0)), Tile("t001", (100, 0))))
    positions = np.array([[0, 0, 0], [10, 5, 0], [100, 0, 0], [90, 5, 0]], np.float64)
    box = SubField((0, 0, 0), (-10, -10, -5), (10, 10, 15))
    picture = tile_map(positions, tiling, [[box], []])
    with_one_tile = tile_map(positions, replace(tiling, tiles=tiling.tiles[:1]), [[box]])
    orange = np.array([255, 127, 14])  # the second colour of tab10
    assert np.any(np.abs(picture.astype(int) - orange).max(-1) < 10)
    assert not np.any(np.abs(with_one_tile.astype(int) - orange).max(-1) < 10)
