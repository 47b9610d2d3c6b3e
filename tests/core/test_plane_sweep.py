"""Depths of planes with a pattern, from cameras side by side."""

from dataclasses import replace

import numpy as np
import pytest

from presight_core.cameras import Camera, pixel_centres
from presight_core.patch_scores import View
from presight_core.plane_sweep import CELL_PX, Cells, grid_shape, sweep
from tests.patterned_scene import FOCAL, GROUND, HEIGHT, WIDTH, Plane, camera_at, depth_m, picture, wall

REFERENCE = camera_at(0, 0)
BESIDE = [camera_at(0, y_m) for y_m in (-1.0, -0.5, 0.5, 1.0)]
SHAPE = grid_shape(WIDTH, HEIGHT)
FACING = Cells(np.broadcast_to((0.0, 0.0, 1.0), (*SHAPE, 3)), np.zeros(SHAPE, np.bool_), np.zeros(SHAPE, np.uint8))
LEVEL = replace(
    FACING, normals=np.broadcast_to((0.0, -1.0, 0.0), (*SHAPE, 3)), is_known=~FACING.is_known
)  # up, in a level camera's axes
INNER = np.s_[2:-2, 6:-6]  # cells that most of the cameras see


def view(camera: Camera, *planes: Plane) -> View:
    return View(picture(camera, *planes), camera)


def views(cameras: list[Camera], *planes: Plane) -> list[View]:
    return [view(camera, *planes) for camera in cameras]


def depths_of(reference: View, cells: Cells, sources: list[View]) -> np.ndarray:
    """In the middle of each cell; 0: unknown."""
    nearness = sweep(reference, cells, sources)[..., 0]
    return np.divide(1, nearness, out=np.zeros_like(nearness), where=nearness > 0)


def true_depth_m(*planes: Plane) -> np.ndarray:
    return depth_m(REFERENCE, *planes)[CELL_PX // 2 :: CELL_PX, CELL_PX // 2 :: CELL_PX]


@pytest.mark.parametrize("distance_m", [4.0, 9.0, 20.0])
def test_a_wall_is_found_where_it_stands(distance_m):
    found = depths_of(view(REFERENCE, wall(distance_m)), FACING, views(BESIDE, wall(distance_m)))
    disparity_px = FOCAL * 1.0 / distance_m  # between the cameras that stand farthest beside
    assert np.abs(found[INNER] / distance_m - 1).max() < 0.75 / disparity_px


def ground_errors(cells: Cells) -> np.ndarray:
    """Relative errors of the ground from 7 to 11 m: nearer no other camera sees it, farther pixels are coarse."""
    ahead = [camera_at(x_m, y_m) for x_m, y_m in ((1.0, -0.7), (1.0, 0.7), (2.0, 0.0), (-1.0, 0.5))]
    truth = true_depth_m(GROUND)
    rows = (truth[:, 0] > 7) & (truth[:, 0] < 11)
    return np.abs(depths_of(view(REFERENCE, GROUND), cells, views(ahead, GROUND)) / truth - 1)[rows, 6:-6]


def test_a_patch_of_the_ground_lies_level():
    level, facing = (ground_errors(cells) for cells in (LEVEL, replace(FACING, is_known=LEVEL.is_known)))
    assert (level < 0.04).mean() > 0.95
    assert (facing < 0.04).mean() < 0.8


def test_a_patch_that_only_faces_the_camera_at_first_is_laid_into_the_plane_of_its_surroundings():
    facade = Plane((0.866, 0.5, 0.0), 5.0)  # 30 degrees off, nearer to the left
    truth, sources = true_depth_m(facade), views(BESIDE, facade)
    known, guessed = (
        np.median(np.abs(depths_of(view(REFERENCE, facade), cells, sources) / truth - 1)[INNER])
        for cells in (replace(FACING, is_known=LEVEL.is_known), FACING)
    )
    assert guessed < 0.5 * known


def test_the_plane_of_a_cell_tells_of_the_cells_beside_it():
    facade, true = Plane((0.866, 0.5, 0.0), 5.0), 1 / true_depth_m(Plane((0.866, 0.5, 0.0), 5.0))
    found = sweep(view(REFERENCE, facade), FACING, views(BESIDE, facade))[INNER]
    assert np.median(np.abs(found[..., 1] / (true[0, 1] - true[0, 0]) - 1)) < 0.1
    assert np.median(np.abs(found[..., 2])) < 0.1 * np.median(np.abs(found[..., 1]))


def test_the_exposure_of_other_images_does_not_matter():
    sources = views(BESIDE, wall(9.0))
    darker = [View((source.grey * 0.4 + 30).astype(np.uint8), source.camera) for source in sources]
    found = depths_of(view(REFERENCE, wall(9.0)), FACING, darker)[INNER]
    assert np.abs(found / 9.0 - 1).mean() < 0.03  # 0.4 as many grey levels tell it less exactly


def with_post(camera: Camera) -> tuple[View, np.ndarray]:
    """A post 4 m ahead, 6 pixels wide, before a wall 9 m ahead; and which pixels (H, W) show it."""
    origin, directions = camera.rays(pixel_centres(WIDTH, HEIGHT))
    beside_m = origin[1] + wall(4.0).distance_m(camera) * directions[:, 1]
    is_post = (np.abs(beside_m + 0.1) < 0.14).reshape(HEIGHT, WIDTH)
    return View(np.where(is_post, picture(camera, wall(4.0)), picture(camera, wall(9.0))), camera), is_post


def test_what_is_too_narrow_for_small_images_is_found_nevertheless():
    reference, is_post = with_post(REFERENCE)
    labels = is_post[CELL_PX // 2 :: CELL_PX, CELL_PX // 2 :: CELL_PX].astype(np.uint8)
    found = depths_of(reference, replace(FACING, labels=labels), [with_post(camera)[0] for camera in BESIDE])
    assert not labels[1::2, 1::2].any()
    assert (np.abs(found[INNER][labels[INNER] > 0] / 4.0 - 1) < 0.05).mean() > 0.8


def test_two_images_that_see_the_place_are_enough():
    random = np.random.default_rng(1)
    hidden = [View(random.integers(0, 255, (HEIGHT, WIDTH), np.uint8), camera) for camera in BESIDE[:2]]
    found = depths_of(view(REFERENCE, wall(9.0)), FACING, [*hidden, *views(BESIDE[2:], wall(9.0))])
    inner = np.s_[2:-2, 2:-8]  # both remaining cameras stand to the left
    assert (np.abs(found[inner] / 9.0 - 1) < 0.06).mean() > 0.95


def test_what_is_plain_is_filled_from_what_is_around_it():
    grey = picture(REFERENCE, wall(9.0))
    grey[20:40, 40:60] = 90
    found = depths_of(View(grey, REFERENCE), FACING, views(BESIDE, wall(9.0)))
    assert np.abs(found[20 // CELL_PX : 40 // CELL_PX, 40 // CELL_PX : 60 // CELL_PX] / 9.0 - 1).max() < 0.15


def test_nothing_is_told_where_nothing_is_looked_for():
    normals = FACING.normals.copy()
    normals[: SHAPE[0] // 2] = 0
    found = depths_of(view(REFERENCE, wall(9.0)), replace(FACING, normals=normals), views(BESIDE, wall(9.0)))
    assert not found[: SHAPE[0] // 2].any()
    assert (found[SHAPE[0] // 2 :] > 0).all()


@pytest.mark.parametrize("yaw_rad", [np.pi, 0.0])
def test_nothing_is_told_where_no_other_image_looks_or_all_is_plain(yaw_rad):
    grey = picture(REFERENCE, wall(9.0)) if yaw_rad else np.full((HEIGHT, WIDTH), 90, np.uint8)
    sources = [View(grey, camera_at(0, y_m, yaw_rad)) for y_m in (-0.5, 0.5)]
    assert not depths_of(View(grey, REFERENCE), FACING, sources).any()


def test_the_result_does_not_depend_on_the_number_of_threads(monkeypatch):
    given = view(REFERENCE, wall(9.0)), FACING, views(BESIDE, wall(9.0))
    results = []
    for count in (1, 3):
        monkeypatch.setattr("numba.get_num_threads", lambda count=count: count)
        results.append(sweep(*given))
    np.testing.assert_array_equal(*results)


def test_images_of_a_few_pixels_are_no_trouble():
    small = [
        View(each.grey[:6, :9], Camera(each.camera.intrinsics, each.camera.world_from_camera, 9, 6))
        for each in views(BESIDE, wall(9.0))
    ]
    shape = grid_shape(9, 6)
    cells = Cells(
        FACING.normals[: shape[0], : shape[1]],
        FACING.is_known[: shape[0], : shape[1]],
        FACING.labels[: shape[0], : shape[1]],
    )
    assert not sweep(small[0], cells, small[1:]).any()
