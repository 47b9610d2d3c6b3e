"""Tiling: cutting a city into tiles, and a tile into sub-fields, by K-Means on camera positions.

Everything here depends on the set of positions and the settings only: not on their order, not on how often
a vehicle stood at one place, and not on the number of threads.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from presight_core.config import TilingSettings
from presight_core.errors import InputError
from presight_core.recipes import digest_of
from presight_core.tiles import SubField, Tile, Tiling, squared_distances

Points = NDArray[np.float64]  # (N, 2) or (N, 3), world metres

VIEW_RANGE_M = 200.0  # a camera sees this far down a street; it also closes the blocks between streets
CELL_M = 25.0  # raster of the mapped area: fine against the view range, cheap for a whole city
PLACE_M = 5.0  # positions in one cell of this size count once, so that a red light does not attract tiles
REACH_RADII = 3.0  # ground farther from every centroid than 3 radii of a round tile belongs to no tile
RESTARTS = 8  # K-Means finds local optima; the best of a few starts is kept
ITERATIONS = 100  # Lloyd's algorithm settles in 10 to 50 on street networks
SETTLED_M = 0.01  # a centimetre of movement changes no tile
MIN_HALF_EXTENT_M = 1.0  # a sub-field's box must not be flat, whatever the margins


def cut_city(city: str, positions_world: ArrayLike, settings: TilingSettings) -> Tiling:
    """The tiles of a city from all its camera positions (N, 3), ids ascending with the centroids' x, then y.

    The number of tiles is `settings.tile_count`, or mapped area / `tile_area_km2`, rounded, at least 1, and more
    where a camera would lie out of every tile's reach. Raises InputError without positions.
    """
    places = _places(_checked(positions_world, f"city {city}"))
    centroids = _tile_centroids(places, settings)
    tiles = _numbered(centroids, first=0)
    tiling_id = digest_of({"city": city, "tiles": [tile.centroid_m for tile in tiles]})
    return Tiling(tiling_id, city, tiles)


def extend_tiling(
    tiling: Tiling, positions_world: ArrayLike, settings: TilingSettings, cut_from_world: ArrayLike = ()
) -> Tiling:
    """The tiling with new tiles on ground out of reach of every tile; existing tiles and the id stay.

    Positions the tiling was cut from are all in reach, unless a fixed `settings.tile_count` made its tiles larger:
    then they must be given, and ground within view of them founds nothing. New tiles are of the usual area.
    """
    places = _places(_checked(positions_world, f"city {tiling.city}"))
    far = places[_distance_m(places, tiling.centroids) > _reach_m(settings)]
    known = np.asarray(cut_from_world, np.float64).reshape(-1, 3)
    if len(known) and len(far):
        far = far[KDTree(_places(known)).query(far)[0] > VIEW_RANGE_M]
    if len(far) == 0:
        return tiling
    usual = settings.model_copy(update={"tile_count": None})
    founded = _numbered(_tile_centroids(far, usual), first=len(tiling.tiles))
    return Tiling(tiling.tiling_id, tiling.city, tiling.tiles + founded)


def sub_fields(positions_world: ArrayLike, settings: TilingSettings) -> tuple[SubField, ...]:
    """The sub-fields of a tile from its camera positions (M, 3): K-Means, then the box rule on each cluster.

    There are `settings.sub_field_count` of them, or as many as there are distinct positions.
    Raises InputError without positions.
    """
    positions = _checked(positions_world, "tile")
    places = np.unique(positions, axis=0)
    centroids = k_means(places, min(settings.sub_field_count, len(places)), settings.seed)
    owners = squared_distances(positions, centroids).argmin(-1)
    kept = np.unique(owners)
    return tuple(_sub_field(centroids[i], positions[owners == i], settings) for i in kept)


def mapped_area_km2(positions_world: ArrayLike) -> float:
    """Ground within 200 m of a camera, square kilometres: a raster of 25 m cells, dilated by a disk."""
    radius = int(VIEW_RANGE_M // CELL_M)
    offsets = np.stack(np.meshgrid(*[np.arange(-radius, radius + 1)] * 2), -1).reshape(-1, 2)
    disk = offsets[(offsets**2).sum(-1) <= radius**2]
    cells = np.unique(np.floor(np.asarray(positions_world, np.float64)[:, :2] / CELL_M).astype(np.int64), axis=0)
    seen = np.unique((cells[:, None] + disk).reshape(-1, 2), axis=0)
    return len(seen) * CELL_M**2 / 1e6


def k_means(points: Points, count: int, seed: int) -> Points:
    """Centroids (count, D) of distinct, lexicographically sorted points (N, D), themselves sorted the same way.

    Lloyd's algorithm from k-means++ starts; the start with the least inertia wins.
    """
    generator = np.random.default_rng(seed)
    best, least = points[:0], np.inf
    for _ in range(RESTARTS if count > 1 else 1):
        centroids = _lloyd(points, _spread_start(points, count, generator))
        inertia = squared_distances(points, centroids).min(-1).sum()
        if inertia < least:
            best, least = centroids, inertia
    return best[np.lexsort(best.T[::-1])]


def box_of(positions_world: Points, settings: TilingSettings) -> tuple[Points, Points]:
    """Lower and upper corner (3,) of the box around a sub-field's camera positions (M, 3).

    The released rule: the 5 and 95 % quantiles of the positions, so that strays do not blow it up, plus margins.
    """
    below = np.array([settings.box_margin_xy_m, settings.box_margin_xy_m, settings.box_margin_below_m])
    above = np.array([settings.box_margin_xy_m, settings.box_margin_xy_m, settings.box_margin_above_m])
    low = np.quantile(positions_world, settings.box_quantile, axis=0) - below
    high = np.quantile(positions_world, 1 - settings.box_quantile, axis=0) + above
    missing = np.maximum(MIN_HALF_EXTENT_M - (high - low) / 2, 0)
    return low - missing, high + missing


def _checked(positions_world: ArrayLike, of_what: str) -> Points:
    positions = np.asarray(positions_world, np.float64).reshape(-1, 3)
    if len(positions) == 0:
        raise InputError(f"{of_what}: no camera positions to cut by; ingest a drive there first")
    if not np.isfinite(positions).all():
        raise InputError(f"{of_what}: {(~np.isfinite(positions)).any(-1).sum()} positions are not finite; re-ingest")
    return positions


def _places(positions_world: Points) -> Points:
    """Sorted centres (M, 2) of the 5 m cells that hold a camera."""
    x, y = np.floor(positions_world[:, :2] / PLACE_M).astype(np.int64).T
    cells = np.unique((x << 32) + y)  # as one number each, cells are sorted ten times as fast; by x, then by y
    y = ((cells + 2**31) & 0xFFFFFFFF) - 2**31
    return (np.stack([(cells - y) >> 32, y], -1).astype(np.float64) + 0.5) * PLACE_M


def _tile_centroids(places: Points, settings: TilingSettings) -> Points:
    if settings.tile_count is not None:
        return k_means(places, min(settings.tile_count, len(places)), settings.seed)
    count = min(len(places), max(1, round(mapped_area_km2(places) / settings.tile_area_km2)))
    centroids = k_means(places, count, settings.seed)
    while _distance_m(places, centroids).max() > _reach_m(settings):
        count += 1
        centroids = k_means(places, count, settings.seed)
    return centroids


def _reach_m(settings: TilingSettings) -> float:
    return REACH_RADII * float(np.sqrt(settings.tile_area_km2 * 1e6 / np.pi))


def _numbered(centroids: Points, first: int) -> tuple[Tile, ...]:
    return tuple(Tile(f"t{first + i:03d}", (float(x), float(y))) for i, (x, y) in enumerate(centroids))


def _sub_field(centroid: Points, members: Points, settings: TilingSettings) -> SubField:
    low, high = box_of(members, settings)
    return SubField(_corner(centroid), _corner(low), _corner(high))


def _corner(point: Points) -> tuple[float, float, float]:
    x, y, z = map(float, point)
    return x, y, z


def _spread_start(points: Points, count: int, generator: np.random.Generator) -> Points:
    """k-means++: each next start is drawn with a chance in proportion to its squared distance to the others."""
    chosen = [points[generator.integers(len(points))]]
    while len(chosen) < count:
        squared = squared_distances(points, np.array(chosen)).min(-1)
        chosen.append(points[generator.choice(len(points), p=squared / squared.sum())])
    return np.array(chosen)


def _lloyd(points: Points, centroids: Points) -> Points:
    for _ in range(ITERATIONS):
        squared = squared_distances(points, centroids)
        moved = _means(points, squared, len(centroids))
        step_m = np.abs(moved - centroids).max()
        centroids = moved
        if step_m < SETTLED_M:
            break
    return centroids


def _means(points: Points, squared: Points, count: int) -> Points:
    """Mean of each cluster's points; an empty cluster restarts at the point farthest from its centroid."""
    owners = squared.argmin(-1)
    sizes = np.bincount(owners, minlength=count)
    sums = np.stack([np.bincount(owners, points[:, axis], count) for axis in range(points.shape[1])], -1)
    means = sums / np.maximum(sizes, 1)[:, None]
    lonely = np.flatnonzero(sizes == 0)
    means[lonely] = points[np.argsort(-squared.min(-1), kind="stable")[: len(lonely)]]
    return means


def _distance_m(points: Points, centroids: Points) -> Points:
    """Distance of each point (N, D) to its nearest centroid."""
    return np.sqrt(squared_distances(points, centroids).min(-1))
