import numpy as np
import pytest

from presight_core.grid import Lattice
from presight_core.tiles import Tile, Tiling


@pytest.fixture
def tiling() -> Tiling:
    return Tiling("frozen", "here", (Tile("t000", (0.0, 0.0)), Tile("t001", (100.0, 0.0)), Tile("t002", (0.0, 80.0))))


def test_the_plane_belongs_to_the_nearest_centroid(tiling):
    assert tiling.nearest([[10, 5], [90, 5], [5, 70]]).tolist() == [0, 1, 2]


def test_the_margin_is_measured_from_the_border_between_two_tiles(tiling):
    points = np.array([[45.0, 0.0], [55.0, 0.0], [65.0, 0.0]])
    assert tiling.within(points, 0, 10).tolist() == [True, True, False]


def test_without_margin_each_point_is_in_one_tile(tiling):
    points = np.random.default_rng(0).uniform(-100, 200, (500, 2))
    counts = sum(tiling.within(points, tile, 0).astype(int) for tile in range(3))
    np.testing.assert_array_equal(counts, 1)


def test_a_single_tile_holds_everything():
    tiling = Tiling("frozen", "here", (Tile("t000", (0.0, 0.0)),))
    assert tiling.within([[1e6, 1e6]], 0, 0).all()


def test_every_block_has_one_owner(tiling):
    blocks = np.array([[0, 0], [7, 0], [0, 6]])
    assert tiling.owner_of(blocks, Lattice()).tolist() == [0, 1, 2]


def test_the_registry_survives_json(tiling):
    assert Tiling.from_json(tiling.to_json()) == tiling
