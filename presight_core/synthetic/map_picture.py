"""The two pictures of a nuScenes map, ten pixels a metre, north up."""

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from shapely.geometry import Polygon

from presight_core.synthetic.city import City

PIXELS_A_METRE = 10  # what nuScenes readers assume of every map picture


def write_map_picture(path: Path, city: City) -> None:
    """Write the semantic prior of a city as PNG: white where one may drive or walk."""
    picture = _canvas(city, 0)
    _fill(picture, (*city.layers.drivable, *city.layers.walkway), 255)
    _write(path, picture)


def write_base_map(path: Path, city: City) -> None:
    """Write `maps/basemap/<location>.png`: the ground in grey as a survey from above would show it."""
    layers = city.layers
    picture = _canvas(city, 30)
    for shapes, grey in (
        (layers.walkway, 110), (layers.drivable, 70), (layers.yellow_paint, 180), (layers.white_paint, 230),
    ):  # fmt: skip
        _fill(picture, shapes, grey)
    _write(path, picture)


def _canvas(city: City, grey: int) -> NDArray[np.uint8]:
    count = round(city.style.size_m * PIXELS_A_METRE)
    return np.full((count, count), grey, np.uint8)


def _fill(picture: NDArray[np.uint8], shapes: Iterable[Polygon], grey: int) -> None:
    for polygon in shapes:
        rings = [np.round(np.asarray(r.coords) * PIXELS_A_METRE) for r in (polygon.exterior, *polygon.interiors)]
        cv2.fillPoly(picture, [ring.astype(np.int32) for ring in rings], [grey])  # even-odd: holes stay as they are


def _write(path: Path, picture: NDArray[np.uint8]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), picture[::-1])
