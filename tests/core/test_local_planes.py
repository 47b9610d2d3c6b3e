"""Planes fitted to the nearness of cells."""

import numpy as np

from presight_core.local_planes import planes_around

ROWS, COLUMNS = np.mgrid[:20, :30]
ONE_LABEL = np.zeros((20, 30), np.uint8)


def nearness_of(plane: tuple[float, float, float]) -> np.ndarray:
    return (plane[0] * COLUMNS + plane[1] * ROWS + plane[2]).astype(np.float32)


def test_a_plane_is_found_in_every_cell_of_it():
    plane = (0.002, -0.001, 0.1)
    np.testing.assert_allclose(planes_around(nearness_of(plane), ONE_LABEL), np.tile(plane, (20, 30, 1)), atol=1e-6)


def test_steps_of_a_staircase_are_taken_for_the_slope_that_they_stand_for():
    plane = (0.003, 0.0, 0.1)
    stairs = nearness_of(plane)[:, COLUMNS[0] // 3 * 3 + 1]
    found = planes_around(stairs, ONE_LABEL)[5:-5, 5:-5]
    np.testing.assert_allclose(found[..., 0], plane[0], rtol=0.3)
    np.testing.assert_allclose(found[..., 1], 0, atol=1e-6)


def test_each_side_of_an_edge_has_its_own_plane():
    near, far = (0.0, 0.001, 0.2), (0.001, 0.0, 0.05)
    left = COLUMNS < 15
    found = planes_around(np.where(left, nearness_of(near), nearness_of(far)), ONE_LABEL)
    np.testing.assert_allclose(found[:, :12], np.tile(near, (20, 12, 1)), atol=1e-6)
    np.testing.assert_allclose(found[:, 18:], np.tile(far, (20, 12, 1)), atol=1e-6)


def test_cells_of_other_labels_and_unknown_ones_do_not_count():
    plane = (0.002, 0.001, 0.1)
    random = np.random.default_rng(0)
    labels = (random.random((20, 30)) < 0.3).astype(np.uint8)
    nearness = np.where(labels == 1, np.float32(0.15), nearness_of(plane))
    nearness[random.random((20, 30)) < 0.2] = 0
    found = planes_around(nearness, labels)
    inner = (labels == 0) & (nearness > 0) & found.any(-1)
    assert inner[3:-3, 3:-3].mean() > 0.5
    np.testing.assert_allclose(found[inner], np.tile(plane, (inner.sum(), 1)), atol=1e-5)
    assert not found[nearness == 0].any()


def test_there_is_no_plane_where_all_cells_say_something_else():
    nearness = np.random.default_rng(0).uniform(0.01, 0.4, (20, 30)).astype(np.float32)
    assert not planes_around(nearness, ONE_LABEL).any()


def test_a_row_of_cells_alone_has_no_plane():
    nearness = np.zeros((20, 30), np.float32)
    nearness[10] = 0.1
    assert not planes_around(nearness, ONE_LABEL).any()
