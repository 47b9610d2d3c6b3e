"""Tiling: cities are cut the same way every time, and boxes follow the rule of the released code."""

import numpy as np
import pytest

from presight_core.config import TilingSettings
from presight_core.errors import InputError
from stages.tiling import box_of, cut_city, extend_tiling, k_means, mapped_area_km2, sub_fields

FOUR_TILES = TilingSettings(tile_count=4)


@pytest.fixture
def town() -> np.ndarray:
    """Camera positions (N, 3) along a few streets in an area of 2 km."""
    generator = np.random.default_rng(3)
    starts = generator.uniform(-1000, 1000, (12, 1, 2))
    streets = starts + np.linspace(0, 1, 60)[None, :, None] * generator.normal(0, 300, (12, 1, 2))
    return np.concatenate([streets.reshape(-1, 2), np.full((720, 1), 1.5)], -1)


def test_the_same_positions_in_another_order_give_the_same_tiles(town):
    shuffled = np.random.default_rng(0).permutation(town)
    assert cut_city("town", shuffled, FOUR_TILES) == cut_city("town", town, FOUR_TILES)


def test_waiting_at_one_place_does_not_move_the_tiles(town):
    waiting = np.concatenate([town, np.repeat(town[:1], 5000, 0)])
    assert cut_city("town", waiting, FOUR_TILES) == cut_city("town", town, FOUR_TILES)


def test_tiles_are_numbered_by_their_centroids_x(town):
    tiling = cut_city("town", town, FOUR_TILES)
    assert [tile.tile_id for tile in tiling.tiles] == ["t000", "t001", "t002", "t003"]
    assert np.all(np.diff(tiling.centroids[:, 0]) > 0)


def test_the_tile_count_follows_the_mapped_area(town):
    area = mapped_area_km2(town)
    tiling = cut_city("town", town, TilingSettings(tile_area_km2=area / 5))
    assert len(tiling.tiles) == 5


def test_a_short_street_is_one_tile():
    street = np.stack([np.linspace(0, 60, 51), np.zeros(51), np.zeros(51)], -1)
    assert len(cut_city("street", street, TilingSettings()).tiles) == 1


def test_one_camera_maps_the_ground_within_its_view():
    assert mapped_area_km2([[12.0, 12.0, 0.0]]) == pytest.approx(np.pi * 0.2**2, rel=0.03)  # raster of 25 m cells


def test_far_positions_get_tiles_of_their_own_though_the_area_asks_for_one():
    pair = np.array([[0.0, 0, 0], [20_000, 0, 0]])
    assert len(cut_city("pair", pair, TilingSettings()).tiles) == 2


def test_a_city_without_positions_is_refused():
    with pytest.raises(InputError, match="no camera positions"):
        cut_city("empty", np.zeros((0, 3)), TilingSettings())


def test_positions_that_are_not_finite_are_refused():
    with pytest.raises(InputError, match="1 positions are not finite"):
        sub_fields([[0, 0, np.nan], [0, 0, 0]], TilingSettings())


def test_extending_with_known_ground_changes_nothing(town):
    tiling = cut_city("town", town, TilingSettings())
    assert extend_tiling(tiling, town, TilingSettings()) is tiling


def test_extending_founds_tiles_on_far_ground_and_keeps_the_old_ones(town):
    tiling = cut_city("town", town, TilingSettings())
    everything = np.concatenate([town, town + np.array([10_000, 0, 0])])
    extended = extend_tiling(tiling, everything, TilingSettings())
    old = len(tiling.tiles)
    assert extended.tiles[:old] == tiling.tiles
    assert [tile.tile_id for tile in extended.tiles[old:]] == [f"t{old + i:03d}" for i in range(old)]
    assert extended.tiling_id == tiling.tiling_id
    assert extend_tiling(extended, everything, TilingSettings()) is extended


def test_a_fixed_tile_count_founds_tiles_on_new_ground_only(town):
    one = TilingSettings(tile_count=1, tile_area_km2=0.01)  # the town lies far out of reach of its one tile
    tiling = cut_city("town", town, one)
    assert extend_tiling(tiling, town, one, town) is tiling
    everything = np.concatenate([town, town + np.array([10_000, 0, 0])])
    extended = extend_tiling(tiling, everything, one, town)
    assert extended.tiles[:1] == tiling.tiles
    assert min(tile.centroid_m[0] for tile in extended.tiles[1:]) > 9_000
    assert extend_tiling(extended, everything, one, town) is extended


def test_k_means_finds_separate_clumps():
    clumps = np.array([[0, 0], [0, 1], [100, 0], [100, 1], [200, 0], [200, 1]], np.float64)
    assert k_means(clumps, 3, seed=0).tolist() == [[0, 0.5], [100, 0.5], [200, 0.5]]


def test_fewer_positions_than_sub_fields_give_a_sub_field_each():
    positions = [[0, 0, 0], [50, 0, 0], [50, 0, 0]]
    fields = sub_fields(positions, TilingSettings(sub_field_count=8))
    assert [field.centroid_m for field in fields] == [(0, 0, 0), (50, 0, 0)]


def test_sub_fields_do_not_depend_on_the_order_of_positions(town):
    shuffled = np.random.default_rng(1).permutation(town)
    assert sub_fields(shuffled, TilingSettings()) == sub_fields(town, TilingSettings())


def test_every_camera_of_the_inner_ninety_percent_lies_in_a_box(town):
    fields = sub_fields(town, TilingSettings(box_quantile=0.0))
    inside = [np.all((town >= field.box_min_m) & (town <= field.box_max_m), -1) for field in fields]
    assert np.any(inside, 0).all()


def test_a_box_is_never_flat():
    thin = TilingSettings(box_margin_xy_m=0.01, box_margin_below_m=0.01, box_margin_above_m=0.01)
    low, high = box_of(np.zeros((1, 3)), thin)
    assert np.all(high - low >= 2.0)


@pytest.mark.parametrize("case", [0, 1, 2])
def test_boxes_equal_those_of_the_released_rule(shared_data, case):
    golden = np.load(shared_data / "golden" / "nerf" / "subfield_aabb.npz")
    positions, owners = golden[f"case{case}_translations"], golden[f"case{case}_labels"]
    for cluster, expected in enumerate(golden[f"case{case}_aabbs_metres"]):
        low, high = box_of(positions[owners == cluster].astype(np.float64), TilingSettings())
        np.testing.assert_allclose([low, high], expected, atol=1e-3)  # float32 at coordinates of kilometres


@pytest.mark.parametrize(
    ("city", "tile_count"),
    # Half the paper's 4, 4 and 2 tiles of these maps, from the fifth of their drives that is at hand.
    [("singapore-onenorth", 2), ("singapore-queenstown", 2), ("singapore-hollandvillage", 1)],
)
def test_real_singapore_maps_get_tiles_of_about_a_square_kilometre(shared_data, city, tile_count):
    poses = np.load(shared_data / "nuscenes_val_ego_poses.npz")
    there = poses["scene_location"][poses["scene_index"]] == city
    positions = poses["world_from_ego"][there, :3, 3].astype(np.float64)
    tiling = cut_city(city, positions, TilingSettings())
    assert len(tiling.tiles) == tile_count
    assert np.bincount(tiling.nearest(positions)).min() > 100
