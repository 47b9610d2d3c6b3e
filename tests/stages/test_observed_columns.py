"""Columns that rays looked through."""

import numpy as np
import pytest

from presight_core.grid import Lattice
from presight_core.priors.schema import unpack_columns
from stages.observed_columns import ObservedColumns

LATTICE = Lattice(voxel_m=0.5, block_columns=8)


def marked(columns: ObservedColumns) -> set[tuple[int, int]]:
    return {
        (int(x), int(y))
        for block in columns.blocks
        for x, y in np.argwhere(unpack_columns(columns.bits(block))) + np.array(block) * LATTICE.block_columns
    }


def crossed_by(origin: np.ndarray, end: np.ndarray) -> set[tuple[int, int]]:
    """Columns whose square the line enters, each tested on its own."""
    low = np.floor(np.minimum(origin, end)[:2] / LATTICE.voxel_m).astype(int) - 1
    high = np.floor(np.maximum(origin, end)[:2] / LATTICE.voxel_m).astype(int) + 1
    found = set()
    for x in range(low[0], high[0] + 1):
        for y in range(low[1], high[1] + 1):
            edges = np.array([[x, x + 1], [y, y + 1]]) * LATTICE.voxel_m
            shares = np.sort((edges - origin[:2, None]) / (end - origin)[:2, None], axis=1)
            if max(shares[:, 0].max(), 0) < min(shares[:, 1].min(), 1):
                found.add((x, y))
    return found


def test_a_ray_marks_exactly_the_columns_it_crosses():
    random = np.random.default_rng(0)
    for _ in range(100):
        origin, end = random.uniform(-6, 6, (2, 3))
        columns = ObservedColumns(LATTICE, reach_m=20.0)
        columns.add(origin, end[None])
        assert marked(columns) == crossed_by(origin, end)


def test_rays_along_the_axes_and_upwards_are_marked():
    columns = ObservedColumns(LATTICE, reach_m=5.0)
    origin = np.array([0.25, 0.25, 1.0])
    ends = origin + np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0], [0, 0, 3.0]])
    columns.add(origin, ends)
    assert marked(columns) == {(x, 0) for x in range(-2, 3)} | {(0, y) for y in range(-2, 3)}


def test_marks_of_several_frames_add_up():
    columns = ObservedColumns(LATTICE, reach_m=5.0)
    columns.add(np.array([0.1, 0.1, 0.0]), np.array([[0.9, 0.1, 0.0]]))
    columns.add(np.array([0.1, 0.6, 0.0]), np.array([[0.9, 0.6, 0.0]]))
    assert marked(columns) == {(0, 0), (1, 0), (0, 1), (1, 1)}


def test_no_rays_mark_nothing():
    columns = ObservedColumns(LATTICE, reach_m=5.0)
    columns.add(np.zeros(3), np.zeros((0, 3)))
    assert marked(columns) == set()


def test_blocks_of_other_tiles_are_forgotten():
    columns = ObservedColumns(LATTICE, reach_m=10.0)
    columns.add(np.array([-3.0, 0.1, 0.0]), np.array([[3.0, 0.1, 0.0]]))
    columns.keep(lambda blocks: blocks[:, 0] >= 0)
    assert columns.blocks == {(0, 0)}
    assert not columns.bits((-1, 0)).any()


def test_a_ray_beyond_the_reach_is_refused():
    columns = ObservedColumns(LATTICE, reach_m=5.0)
    with pytest.raises(AssertionError, match="reach_m"):
        columns.add(np.zeros(3), np.array([[100.0, 0.0, 0.0]]))
