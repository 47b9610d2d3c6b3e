"""Tiles of a city and the sub-fields of a tile."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from presight_core.grid import Lattice


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
        return self._distances(points_world).argmin(-1)

    def within(self, points_world: ArrayLike, tile: int, margin_m: float) -> NDArray[np.bool_]:
        """Which points (N, 2 or 3) lie in the tile's cell or within `margin_m` of it."""
        squared = self._distances(points_world) ** 2
        between = np.linalg.norm(self.centroids - self.centroids[tile], axis=-1)
        # Signed distance to the bisector of two centroids; positive on the other tile's side.
        beyond = (squared[:, tile, None] - squared) / (2 * np.maximum(between, 1e-9))
        beyond[:, tile] = -np.inf
        return beyond.max(-1) <= margin_m

    def owner_of(self, blocks: ArrayLike, lattice: Lattice) -> NDArray[np.int64]:
        """Index of the tile that owns each lattice block (N, 2): the one nearest to the block's centre."""
        return self.nearest(lattice.block_centre(blocks))

    def _distances(self, points_world: ArrayLike) -> NDArray[np.float64]:
        points = np.asarray(points_world, np.float64)[:, :2]
        return np.linalg.norm(points[:, None] - self.centroids[None], axis=-1)

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
