"""Depths of cells that suit those around them, on grids made by hand."""

import os
import subprocess
import sys

import numpy as np
import pytest

from presight_core.semi_global import best_places

SHAPE = 9, 12
DEPTHS = 20
NEARNESS = np.linspace(0.5, 0.02, DEPTHS)
FACING = np.broadcast_to((0.0, 0.0, 1.0), (*SHAPE, 3))  # the same nearness everywhere
ALIKE = np.zeros(SHAPE, np.uint8)
EVERYWHERE = np.broadcast_to((0, DEPTHS), (*SHAPE, 2))


def scores_at(places: np.ndarray, best: float = 0.9) -> np.ndarray:
    """Scores that fall off to both sides of each cell's place."""
    away = np.abs(np.arange(DEPTHS) - places[..., None])
    return np.clip(best - 0.2 * away, 0, 1)


def test_cells_that_all_agree_keep_their_depth_and_its_fraction():
    for place in (7.0, 7.3, 7.7):
        places = best_places(scores_at(np.full(SHAPE, place)), EVERYWHERE, FACING, ALIKE, NEARNESS)
        np.testing.assert_allclose(places, place, atol=0.25)  # drawn a little to whole ones


def test_a_cell_that_is_plain_takes_the_depth_of_those_around_it():
    scores = scores_at(np.full(SHAPE, 7.0))
    scores[3:6, 4:8] = 0
    np.testing.assert_allclose(best_places(scores, EVERYWHERE, FACING, ALIKE, NEARNESS), 7, atol=0.2)


def test_a_cell_alone_against_all_others_gives_way_unless_it_is_another_thing():
    places, labels = np.full(SHAPE, 7.0), ALIKE.copy()
    places[4, 6] = 15
    assert best_places(scores_at(places, 0.8), EVERYWHERE, FACING, ALIKE, NEARNESS)[4, 6] == pytest.approx(7, abs=0.5)
    labels[4, 6] = 5
    assert best_places(scores_at(places, 0.8), EVERYWHERE, FACING, labels, NEARNESS)[4, 6] == pytest.approx(15, abs=0.5)


def test_what_two_halves_show_well_stays_apart():
    places = np.full(SHAPE, 4.0)
    places[:, 6:] = 15
    np.testing.assert_allclose(best_places(scores_at(places), EVERYWHERE, FACING, ALIKE, NEARNESS), places, atol=0.5)


def test_plain_ground_goes_on_as_ground():
    """The nearness of the ground falls evenly from row to row: only its first and last rows have a pattern."""
    nearness = np.broadcast_to((0.45 - 0.05 * np.arange(SHAPE[0]))[:, None], SHAPE)
    truth = (nearness - NEARNESS[0]) / (NEARNESS[1] - NEARNESS[0])
    scores = scores_at(truth)
    scores[2:-2] = 0
    ground = np.broadcast_to((0.0, -0.05, 0.45), (*SHAPE, 3))
    np.testing.assert_allclose(best_places(scores, EVERYWHERE, ground, ALIKE, NEARNESS), truth, atol=0.6)
    assert np.abs(best_places(scores, EVERYWHERE, FACING, ALIKE, NEARNESS) - truth)[2:-2].max() > 2


def test_depths_out_of_reach_do_not_count():
    scores, reach = scores_at(np.full(SHAPE, 7.0)), EVERYWHERE.copy()
    reach[4, 6] = 9, 16
    places = best_places(scores, reach, FACING, ALIKE, NEARNESS)
    assert places[4, 6] == pytest.approx(9, abs=0.5)
    elsewhere = np.delete(places.ravel(), 4 * SHAPE[1] + 6)
    np.testing.assert_allclose(elsewhere, 7, atol=0.25)  # it does not draw others to where they are not


def test_cells_with_a_short_reach_find_what_they_find_with_a_long_one():
    truth = np.broadcast_to(5.0 + 0.8 * np.arange(SHAPE[1]), SHAPE)
    reach = np.stack([truth - 4, truth + 5], -1).clip(0, DEPTHS).astype(np.int64)
    scores = scores_at(truth)
    scores[3:6, 4:8] = 0
    short, far = (best_places(scores, each, FACING, ALIKE, NEARNESS) for each in (reach, EVERYWHERE))
    np.testing.assert_allclose(short, far, atol=0.5)


def test_no_path_crosses_cells_that_are_left_out():
    scores, planes = scores_at(np.full(SHAPE, 7.0)), FACING.copy()
    scores[:, 5:], planes[:, 5] = 0, 0  # a column of sky, and behind it nothing but plain cells
    places = best_places(scores, EVERYWHERE, planes, ALIKE, NEARNESS)
    np.testing.assert_allclose(places[:, :5], 7, atol=0.2)
    assert np.isnan(places[:, 5:]).all()


def test_code_compiled_now_and_code_from_the_cache_agree(tmp_path):
    program = (
        "import sys, numpy as np; from presight_core.semi_global import best_places;"
        "scores = np.random.default_rng(0).random((16, 24, 200), np.float32);"
        "planes, labels = np.broadcast_to((0.0, -0.01, 1.0), (16, 24, 3)), np.zeros((16, 24), np.uint8);"
        "reach = np.broadcast_to((0, 200), (16, 24, 2));"
        "places = best_places(scores, reach, planes, labels, np.linspace(0.4, 0.01, 200));"
        "sys.stdout.buffer.write(places.tobytes())"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    first, second = (
        subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, check=True).stdout
        for _ in range(2)
    )
    assert first == second
