"""How high the cameras of a tile were, place by place."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

HEIGHT_CELL_M = 2.0  # cameras this near count as one place, so that a parked vehicle does not outvote the road
HEIGHT_CELLS = 4  # places averaged: about 8 m of road


class CameraHeights:
    """How high the cameras near a place were: what heights are relative to, so that hills do not matter.

    Where roads cross on two levels, this is between them.
    """

    def __init__(self, positions_world: NDArray[np.float64]) -> None:
        cells = np.floor(positions_world[:, :2] / HEIGHT_CELL_M).astype(np.int64)
        _, inverse, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
        sums = np.zeros((len(counts), 3))
        np.add.at(sums, inverse.ravel(), positions_world)
        places = sums / counts[:, None]
        self._tree = KDTree(places[:, :2])
        self._heights_m = places[:, 2]

    def at(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mean height (N,), metres, of the cameras nearest to points (N, 3), distances taken on the map."""
        return self.nearest(points_world)[0]

    def nearest(self, points_world: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """As `at`, and the distance (N,) on the map, metres, of the nearest camera."""
        count = min(HEIGHT_CELLS, len(self._heights_m))
        distances_m, nearest = self._tree.query(points_world[:, :2], k=count)
        shape = len(points_world), count
        return self._heights_m[nearest.reshape(shape)].mean(-1), distances_m.reshape(shape)[:, 0]
