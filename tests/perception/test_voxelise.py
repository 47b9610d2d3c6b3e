"""Voxels from points, without golden values."""

import numpy as np
import pytest
import torch
from scipy.spatial import Delaunay

from presight_perception.voxelise import (
    MAPPING_GRID,
    OCCUPANCY_GRID,
    BevAugmentation,
    VoxelDrop,
    VoxelGrid,
    Voxels,
    inside_range,
    voxelise,
    voxelise_tensors,
)

GRID = VoxelGrid((-2.0, -1.0, 0.0), (2.0, 1.0, 1.0), (0.5, 0.5, 0.25))


def example(count: int = 200) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    return random.uniform(-2.5, 2.5, (count, 3)) / [1, 2, 4], random.random((count, 3)), random.uniform(0.1, 4, count)


def test_the_released_grids_have_the_released_shapes():
    assert MAPPING_GRID.shape == (200, 100, 16)
    assert OCCUPANCY_GRID.shape == (200, 200, 20)


def test_voxels_equal_a_slow_loop():
    points, features, hits = example()
    cells: dict[tuple[int, ...], list[int]] = {}
    for row, point in enumerate(points):
        cell = tuple(int(np.floor((point[axis] - GRID.low_m[axis]) / GRID.voxel_m[axis])) for axis in range(3))
        if all(0 <= number < count for number, count in zip(cell, GRID.shape, strict=True)):
            cells.setdefault(cell, []).append(row)
    found = voxelise(points, features, hits, GRID)
    assert [tuple(cell) for cell in found.coordinates.tolist()] == sorted(cells)
    for voxel, cell in zip(found.features, sorted(cells), strict=True):
        rows = cells[cell]
        mean = sum(hits[row] * points[row] for row in rows) / hits[rows].sum()
        np.testing.assert_allclose(voxel[:3], (mean - GRID.low_m) / np.subtract(GRID.high_m, GRID.low_m), rtol=1e-6)
        np.testing.assert_allclose(voxel[3:6], np.average(features[rows], 0, hits[rows]), rtol=1e-6)
        assert voxel[6] == pytest.approx(np.log(hits[rows].sum()), abs=1e-6)


@pytest.mark.parametrize("with_features", [True, False])
def test_torch_makes_the_same_voxels(with_features):
    points, features, hits = example()
    plain = voxelise(points, features if with_features else None, hits, GRID)
    tensors = [torch.from_numpy(part) for part in (points, features, hits)]
    found = voxelise_tensors(tensors[0], tensors[1] if with_features else None, tensors[2], GRID)
    np.testing.assert_array_equal(found.coordinates, plain.coordinates)
    np.testing.assert_allclose(found.features, plain.features, atol=1e-7)


def test_bytes_are_shares_of_255():
    points, features, hits = example()
    stored = np.round(features * 255).astype(np.uint8)
    expected = voxelise(points, stored / 255, hits, GRID)
    np.testing.assert_allclose(voxelise(points, stored, hits, GRID).features, expected.features, atol=1e-6)
    tensors = [torch.from_numpy(part) for part in (points, stored, hits)]
    found = voxelise_tensors(tensors[0], tensors[1], tensors[2], GRID)
    np.testing.assert_allclose(found.features, expected.features, atol=1e-6)


def test_no_points_make_no_voxels():
    found = voxelise(np.zeros((0, 3)), np.zeros((0, 64)), np.zeros(0), GRID)
    assert found.features.shape == (0, 68)
    assert found.coordinates.shape == (0, 3)


def test_an_augmentation_turns_then_scales_then_mirrors():
    matrix = BevAugmentation(np.pi / 2, 2.0, flip_x=True).matrix
    np.testing.assert_allclose([[1.0, 0.0, 3.0], [0.0, 1.0, 0.0]] @ matrix.T, [[0, 2, 6], [2, 0, 0]], atol=1e-12)


def test_both_faces_of_the_range_are_inside():
    assert inside_range([[-2.0, -1.0, 0.0], [2.0, 1.0, 1.0], [2.01, 0.0, 0.0]], GRID).tolist() == [True, True, False]


def hundred_voxels() -> Voxels:
    return Voxels(np.arange(100, dtype=np.float32)[:, None], np.zeros((100, 3), np.int32))


def test_a_drop_loses_an_even_share_of_the_voxels_and_keeps_their_order():
    shares = []
    for seed in range(300):
        kept = VoxelDrop().apply(hundred_voxels(), np.random.default_rng(seed))
        assert (np.diff(kept.features[:, 0]) > 0).all()
        shares.append(len(kept.features) / 100)
    assert np.mean(shares) == pytest.approx(0.5, abs=0.05)
    assert np.std(shares) == pytest.approx(12**-0.5, abs=0.05)  # of an even distribution over 0..1


def test_a_drop_can_lose_the_whole_prior():
    drop = VoxelDrop(greatest_share=0.0, whole_chance=0.4)
    random = np.random.default_rng(0)
    sizes = [len(drop.apply(hundred_voxels(), random).features) for _ in range(1000)]
    assert set(sizes) == {0, 100}
    assert sizes.count(0) / 1000 == pytest.approx(0.4, abs=0.05)


def test_a_drop_can_lose_one_side_of_the_prior():
    x, y = (axis.reshape(-1) for axis in np.meshgrid(np.arange(20), np.arange(20), indexing="ij"))
    voxels = Voxels(np.zeros((400, 5), np.float32), np.stack([x, y, np.zeros_like(x)], -1).astype(np.int32))
    drop, shares = VoxelDrop(greatest_share=0.0, side_chance=0.5), []
    for seed in range(200):
        kept = drop.apply(voxels, np.random.default_rng(seed)).coordinates[:, :2]
        shares.append(len(kept) / 400)
        if 0.2 < shares[-1] < 0.8:
            is_lost = np.ones((20, 20), np.bool_)
            is_lost[kept[:, 0], kept[:, 1]] = False
            lost = np.argwhere(is_lost)
            assert (Delaunay(kept).find_simplex(lost) < 0).all()  # none within what was kept: a line parts them
    whole = np.array(shares) == 1
    assert whole.mean() == pytest.approx(0.5, abs=0.1)
    assert np.mean(np.array(shares)[~whole]) == pytest.approx(0.5, abs=0.1)
