"""Tiles of a city and the sub-fields of a tile."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from presight_core.grid import Lattice, morton

CHUNK_POINTS = 4096  # at once, against the tiles around them: few enough to lie close together
CELL_M = 50.0  # by which points are brought into an order of space
ROUNDING_M = 1e-6


@dataclass(frozen=True)
class Tile:
    """A part of a city, trained as one field; the plane belongs to the nearest centroid."""

    tile_id: str  # "t000", never reused
    centroid_m: tuple[float, float]  # world x, y


@dataclass(frozen=True)
class Tiling:
    """A city's frozen registry of tiles. New tiles may be appended; existing ones never move."""

    tiling_id: str
    city: str
    tiles: tuple[Tile, ...]

    @property
    def centroids(self) -> NDArray[np.float64]:
        """Tile centroids (T, 2), world metres."""
        return np.array([tile.centroid_m for tile in self.tiles], np.float64).reshape(-1, 2)

    def nearest(self, points_world: ArrayLike) -> NDArray[np.int64]:
        """Index of the tile nearest to each point (N, 2 or 3)."""
        return squared_distances(np.asarray(points_world, np.float64)[:, :2], self.centroids).argmin(-1)

    def within(self, points_world: ArrayLike, tile: int, margin_m: float) -> NDArray[np.bool_]:
        """Which points (N, 2 or 3) lie in the tile's cell or within `margin_m` of it."""
        inside = np.zeros(len(np.asarray(points_world)), np.bool_)
        inside[self.rows_within(points_world, margin_m)[tile]] = True
        return inside

    def rows_within(self, points_world: ArrayLike, margin_m: float) -> list[NDArray[np.int64]]:
        """Rows of the points (N, 2 or 3) that lie in each tile's cell or within `margin_m` of it, ascending."""
        points = np.asarray(points_world, np.float64)[:, :2]
        nearby = np.argsort(morton(np.floor(points / CELL_M)), kind="stable")  # neighbours in space follow each other
        pairs = [np.empty((2, 0), np.int64)]
        for start in range(0, len(points), CHUNK_POINTS):
            rows = nearby[start : start + CHUNK_POINTS]
            row, tile = self._pairs_within(points[rows], margin_m)
            pairs.append(np.stack([rows[row], tile]))
        rows, tiles = np.concatenate(pairs, -1)
        order = np.lexsort([rows, tiles])
        return np.split(rows[order], np.cumsum(np.bincount(tiles, minlength=len(self.tiles)))[:-1])

    def _pairs_within(self, points: NDArray[np.float64], margin_m: float) -> tuple[NDArray, NDArray]:
        """Rows and tiles (P,) of all pairs of a point and a tile that has it within the margin.

        With the bisector to its nearest centroid at most the margin away, no tile's centroid is farther from a point
        than that one is, plus twice the margin; and only bisectors to nearer centroids can be farther away.
        """
        middle = (points.min(0) + points.max(0)) / 2
        spread = np.sqrt(squared_distances(points, middle[None]).max())
        from_middle = np.sqrt(squared_distances(middle[None], self.centroids)[0])
        candidates = np.flatnonzero(from_middle <= from_middle.min() + 2 * (spread + margin_m) + ROUNDING_M)
        centroids = self.centroids[candidates]
        squared = squared_distances(points, centroids)
        distances = np.sqrt(squared)
        row, tile = np.nonzero(distances <= distances.min(-1, keepdims=True) + 2 * margin_m + ROUNDING_M)
        between = np.sqrt(squared_distances(centroids, centroids))
        # Signed distance to the bisector of two centroids; positive on the other tile's side.
        beyond = (squared[row, tile, None] - squared[row]) / (2 * np.maximum(between[tile], 1e-9))
        beyond[np.arange(len(row)), tile] = -np.inf
        inside = beyond.max(-1) <= margin_m
        return row[inside], candidates[tile[inside]]

    def owner_of(self, blocks: ArrayLike, lattice: Lattice) -> NDArray[np.int64]:
        """Index of the tile that owns each lattice block (N, 2): the one nearest to the block's centre."""
        return self.nearest(lattice.block_centre(blocks))

    def to_json(self) -> dict[str, Any]:
        """The registry as JSON values."""
        tiles = [{"tile_id": tile.tile_id, "centroid_m": list(tile.centroid_m)} for tile in self.tiles]
        return {"tiling_id": self.tiling_id, "city": self.city, "tiles": tiles}

    @staticmethod
    def from_json(value: dict[str, Any]) -> "Tiling":
        """The registry that `to_json` wrote."""
        tiles = tuple(Tile(tile["tile_id"], tuple(tile["centroid_m"])) for tile in value["tiles"])
        return Tiling(value["tiling_id"], value["city"], tiles)


@dataclass(frozen=True)
class SubField:
    """One hash-grid field of a tile: samples nearest to `centroid_m` are its own; the box is its uncontracted core."""

    centroid_m: tuple[float, float, float]
    box_min_m: tuple[float, float, float]
    box_max_m: tuple[float, float, float]

    def to_json(self) -> dict[str, Any]:
        """The sub-field as JSON values."""
        return {name: list(getattr(self, name)) for name in ("centroid_m", "box_min_m", "box_max_m")}


def squared_distances(points: NDArray[np.float64], centroids: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, K), square metres, of points (N, D) and centroids (K, D).

    Differences first, so that coordinates of kilometres keep their millimetres.
    """
    squared = np.zeros((len(points), len(centroids)))
    for axis in range(points.shape[1]):
        squared += np.subtract.outer(points[:, axis], centroids[:, axis]) ** 2
    return squared
