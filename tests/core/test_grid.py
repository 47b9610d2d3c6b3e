import numpy as np

from presight_core.grid import Lattice, morton


def test_a_voxel_holds_its_own_points():
    lattice = Lattice()
    points = np.random.default_rng(0).uniform(-500, 500, (1000, 3))
    low = lattice.voxel_min(lattice.voxel_of(points))
    assert ((points >= low - 1e-9) & (points < low + lattice.voxel_m + 1e-9)).all()


def test_negative_columns_fall_into_negative_blocks():
    blocks = Lattice().block_of(np.array([[-1, 0, 0], [-32, 31, 0], [-33, 32, 0]]))
    np.testing.assert_array_equal(blocks, [[-1, 0], [-1, 0], [-2, 1]])


def test_morton_keys_are_distinct_and_keep_neighbours_together():
    grid = np.stack(np.meshgrid(np.arange(-8, 8), np.arange(-8, 8)), -1).reshape(-1, 2)
    keys = morton(grid)
    assert len(np.unique(keys)) == len(grid)
    quad = morton(np.array([[2, 2], [3, 2], [2, 3], [3, 3]]))
    assert quad.max() - quad.min() == 3


def test_morton_order_holds_across_zero():
    assert morton(np.array([[-1, -1]]))[0] < morton(np.array([[0, 0]]))[0]


def test_a_block_centre_lies_in_its_block():
    lattice = Lattice()
    blocks = np.array([[-3, 7], [0, 0]])
    centres = np.concatenate([lattice.block_centre(blocks), np.zeros((2, 1))], 1)
    np.testing.assert_array_equal(lattice.block_of(lattice.voxel_of(centres)), blocks)
