"""Plain-torch operations against slow loops."""

import numpy as np
import torch

from presight_perception.bev_pooling import PoolingGrid, bev_pool
from presight_perception.deformable_attention import deformable_attention


def bilinear(image: np.ndarray, x: float, y: float) -> np.ndarray:
    """A value (D,) of an image (H, W, D) at a place in pixels, the first pixel's centre being 0; zeros outside."""
    total = np.zeros(image.shape[2])
    for row in (int(np.floor(y)), int(np.floor(y)) + 1):
        for column in (int(np.floor(x)), int(np.floor(x)) + 1):
            if 0 <= row < image.shape[0] and 0 <= column < image.shape[1]:
                total += (1 - abs(y - row)) * (1 - abs(x - column)) * image[row, column]
    return total


def test_deformable_attention_equals_a_loop():
    random, shapes = np.random.default_rng(0), [(3, 5), (2, 2)]
    value = random.normal(size=(1, 19, 2, 3))
    locations, weights = random.uniform(-0.2, 1.2, (1, 4, 2, 2, 3, 2)), random.random((1, 4, 2, 2, 3))
    expected = np.zeros((4, 2, 3))
    for query, head, level, point in np.ndindex(4, 2, 2, 3):
        height, width = shapes[level]
        image = value[0, 15 * level : 15 + 4 * level, head].reshape(height, width, 3)
        x, y = locations[0, query, head, level, point] * [width, height] - 0.5
        expected[query, head] += weights[0, query, head, level, point] * bilinear(image, x, y)
    value, locations, weights = (torch.from_numpy(part) for part in (value, locations, weights))
    found = deformable_attention(value, shapes, locations, weights)
    np.testing.assert_allclose(found[0], expected.reshape(4, 6), atol=1e-12)


def test_pooling_equals_a_loop():
    random = np.random.default_rng(0)
    grid = PoolingGrid((-2.0, -1.0, 0.0), (1.0, 0.5, 1.0), (4, 4, 2))
    points = random.uniform(-3, 3, (2, 2, 3, 2, 2, 3))
    depth, features = random.random((2, 2, 3, 2, 2)), random.normal(size=(2, 2, 5, 2, 2))
    expected = np.zeros((2, 5, 2, 4, 4))
    for sample, camera, bin_, row, column in np.ndindex(2, 2, 3, 2, 2):
        x, y, z = np.trunc((points[sample, camera, bin_, row, column] - grid.low_m) / grid.voxel_m).astype(int)
        if 0 <= x < 4 and 0 <= y < 4 and 0 <= z < 2:
            weight = depth[sample, camera, bin_, row, column]
            expected[sample, :, z, y, x] += weight * features[sample, camera, :, row, column]
    found = bev_pool(*(torch.from_numpy(part) for part in (points, depth, features)), grid)
    np.testing.assert_allclose(found, expected, atol=1e-12)
