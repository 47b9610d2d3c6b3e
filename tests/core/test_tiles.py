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


def plainly_within(tiling: Tiling, points: np.ndarray, tile: int, margin_m: float) -> np.ndarray:
    """The definition: no bisector to another centroid is farther behind the point than the margin."""
    squared = ((points[:, None] - tiling.centroids) ** 2).sum(-1)
    others = [other for other in range(len(tiling.tiles)) if other != tile]
    between = np.linalg.norm(tiling.centroids[others] - tiling.centroids[tile], axis=-1)
    return ((squared[:, [tile]] - squared[:, others]) / (2 * between)).max(-1) <= margin_m


@pytest.mark.parametrize("margin_m", [0.0, 15.0, 400.0])
def test_rows_within_are_those_of_the_plain_definition(margin_m):
    random = np.random.default_rng(1)
    places = random.uniform(0, 2000, (40, 2))
    tiling = Tiling("frozen", "here", tuple(Tile(f"t{i:03d}", (float(x), float(y))) for i, (x, y) in enumerate(places)))
    points = random.uniform(-500, 2500, (5000, 2))  # more than are looked at at once
    for tile, rows in enumerate(tiling.rows_within(points, margin_m)):
        np.testing.assert_array_equal(rows, np.flatnonzero(plainly_within(tiling, points, tile, margin_m)))


def test_no_point_is_within_no_tile(tiling):
    assert [rows.tolist() for rows in tiling.rows_within(np.empty((0, 3)), 5.0)] == [[], [], []]


def test_a_single_tile_holds_everything():
    tiling = Tiling("frozen", "here", (Tile("t000", (0.0, 0.0)),))
    assert tiling.within([[1e6, 1e6]], 0, 0).all()


def test_every_block_has_one_owner(tiling):
    blocks = np.array([[0, 0], [7, 0], [0, 6]])
    assert tiling.owner_of(blocks, Lattice()).tolist() == [0, 1, 2]


def test_the_registry_survives_json(tiling):
    assert Tiling.from_json(tiling.to_json()) == tiling
