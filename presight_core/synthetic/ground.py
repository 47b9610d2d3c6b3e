"""The ground: gentle waves, and how flat geometry is draped over them."""

from collections.abc import Iterable

import mapbox_earcut
import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from presight_core.frames import transform
from presight_core.synthetic.layers import polygons
from presight_core.synthetic.mesh import MeshBuilder, Surface

CURB_M = 0.15  # sidewalks stand this far above the road
SAG_M = 0.004  # triangles follow the waves as closely as this, a third of the height of paint above asphalt
WAVE_COUNT = 4
LARGEST_CELL_M = 40.0  # also what lies on flat ground is cut, for culling


class Terrain:
    """The height of a city's road surface: gentle waves around zero, of a total amplitude `relief_m`.

    Ego poses say z = 0 everywhere, as nuScenes does, while the car follows the ground: a real error between drives
    that mapping has to bear. Wave lengths of 250 to 500 m keep it smooth along a drive.
    """

    def __init__(self, seed: int, relief_m: float):
        rng = np.random.default_rng([seed, 3])  # a stream of its own: relief changes nothing else of a city
        shares = rng.uniform(0.5, 1, WAVE_COUNT)
        self._amplitudes_m = relief_m * shares / shares.sum()
        bearings, lengths_m = rng.uniform(0, 2 * np.pi, WAVE_COUNT), rng.uniform(250, 500, WAVE_COUNT)
        self._waves = 2 * np.pi / lengths_m[:, None] * np.c_[np.cos(bearings), np.sin(bearings)]  # (4, 2) radians/m
        self._phases = rng.uniform(0, 2 * np.pi, WAVE_COUNT)

    def height_m(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Height of the road surface at places (...,)."""
        return (np.sin(self._angles(x_m, y_m)) * self._amplitudes_m).sum(-1)

    def lowest_m(self, points: NDArray[np.float64]) -> float:
        """The least height at any of the points (N, 2)."""
        return float(self.height_m(points[:, 0], points[:, 1]).min())

    def stand(self, x_m: float, y_m: float, yaw_rad: float) -> NDArray[np.float64]:
        """world_from_ego (4, 4) of a car on the ground: it pitches and rolls with the slope."""
        slope_x, slope_y = (np.cos(self._angles(x_m, y_m)) * self._amplitudes_m) @ self._waves
        heading = np.array([np.cos(yaw_rad), np.sin(yaw_rad), 0.0])
        heading[2] = heading[0] * slope_x + heading[1] * slope_y
        up = np.array([-slope_x, -slope_y, 1.0])
        forward, up = heading / np.linalg.norm(heading), up / np.linalg.norm(up)
        place = [x_m, y_m, float(self.height_m(x_m, y_m))]
        return transform(np.stack([forward, np.cross(up, forward), up], -1), place)

    def drape(
        self,
        builder: MeshBuilder,
        shapes: Iterable[Polygon],
        surface: Surface,
        above_m: float,
        cell_m: float | None = None,
    ) -> None:
        """Lay polygons this far above the ground, cut into cells so that they follow it."""
        for shape in shapes:
            for part in _cells(shape, cell_m or self.cell_m):
                vertices, faces = triangulate(part)
                heights = self.height_m(vertices[:, 0], vertices[:, 1]) + above_m
                builder.add(np.c_[vertices, heights], faces, surface)

    @property
    def cell_m(self) -> float:
        """Edge of squares whose triangles deviate from the waves by less than SAG_M."""
        bend = float((self._amplitudes_m * (self._waves**2).sum(1)).sum())  # the largest curvature, 1/m
        return float(min(np.sqrt(8 * SAG_M / max(bend, 1e-12) / 2), LARGEST_CELL_M))  # sagitta over a diagonal

    def _angles(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        x, y = np.asarray(x_m, np.float64)[..., None], np.asarray(y_m, np.float64)[..., None]
        return x * self._waves[:, 0] + y * self._waves[:, 1] + self._phases  # no matmul: it rounds as it likes


def triangulate(polygon: Polygon) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (N, 2) and counter-clockwise triangles (K, 3) of a polygon with holes."""
    rings = [np.asarray(ring.coords)[:-1] for ring in (polygon.exterior, *polygon.interiors)]
    vertices = np.concatenate(rings)
    ends = np.cumsum([len(ring) for ring in rings]).astype(np.uint32)
    faces = mapbox_earcut.triangulate_float64(vertices, ends).reshape(-1, 3).astype(np.int64)
    first, second = (vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2))
    clockwise = first[:, 0] * second[:, 1] < first[:, 1] * second[:, 0]
    faces[clockwise] = faces[clockwise][:, ::-1]
    return vertices, faces


def _cells(shape: BaseGeometry, cell_m: float) -> list[Polygon]:
    low_x, low_y, high_x, high_y = shape.bounds
    if max(high_x - low_x, high_y - low_y) <= cell_m:
        return polygons(shape)
    cells = []
    for x in np.arange(np.floor(low_x / cell_m), np.ceil(high_x / cell_m)) * cell_m:
        column = shapely.clip_by_rect(shape, x, low_y - 1, x + cell_m, high_y + 1)
        for y in np.arange(np.floor(low_y / cell_m), np.ceil(high_y / cell_m)) * cell_m:
            cells += polygons(shapely.clip_by_rect(column, x, y, x + cell_m, y + cell_m))
    return cells
