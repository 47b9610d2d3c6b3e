"""The ground: gentle waves, and how flat geometry is draped over them."""

from collections.abc import Iterable

import mapbox_earcut
import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from presight_core.synthetic.layers import polygons
from presight_core.synthetic.mesh import MeshBuilder, Surface

CURB_M = 0.15  # sidewalks stand this far above the road
CELL_M = 20.0  # triangles this size follow the waves to 2 mm


def height_m(x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
    """Height of the road surface, within 6 cm of zero.

    Ego poses say z = 0 everywhere, as nuScenes does, while the car follows the ground: a real error of a few
    centimetres between drives that mapping has to bear. Waves of 300 to 500 m keep it smooth along a drive.
    """
    x, y = np.asarray(x_m, np.float64), np.asarray(y_m, np.float64)
    return 0.035 * np.sin(x / 61 + 1.3) * np.cos(y / 47 + 0.4) + 0.025 * np.sin((x + y) / 83)


def drape(
    builder: MeshBuilder, shapes: Iterable[Polygon], surface: Surface, above_m: float, cell_m: float = CELL_M
) -> None:
    """Lay polygons this far above the ground, cut into cells so that they follow it."""
    for shape in shapes:
        for part in _cells(shape, cell_m):
            vertices, faces = triangulate(part)
            heights = height_m(vertices[:, 0], vertices[:, 1]) + above_m
            builder.add(np.c_[vertices, heights], faces, surface)


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
    if max(high_x - low_x, high_y - low_y) <= 1.5 * cell_m:
        return polygons(shape)
    cells = []
    for x in np.arange(np.floor(low_x / cell_m), np.ceil(high_x / cell_m)) * cell_m:
        column = shapely.clip_by_rect(shape, x, low_y - 1, x + cell_m, high_y + 1)
        for y in np.arange(np.floor(low_y / cell_m), np.ceil(high_y / cell_m)) * cell_m:
            cells += polygons(shapely.clip_by_rect(column, x, y, x + cell_m, y + cell_m))
    return cells
