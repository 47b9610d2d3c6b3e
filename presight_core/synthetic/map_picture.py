"""The map picture of nuScenes: white where one may drive or walk, ten pixels a metre, north up."""

from pathlib import Path

import cv2
import numpy as np

from presight_core.synthetic.city import City

PIXELS_A_METRE = 10  # what nuScenes readers assume of every map picture


def write_map_picture(path: Path, city: City) -> None:
    """Write the semantic prior of a city as PNG."""
    count = round(city.style.size_m * PIXELS_A_METRE)
    picture = np.zeros((count, count), np.uint8)
    for polygon in (*city.layers.drivable, *city.layers.walkway):
        rings = [np.round(np.asarray(r.coords) * PIXELS_A_METRE) for r in (polygon.exterior, *polygon.interiors)]
        filled = np.zeros_like(picture)
        cv2.fillPoly(filled, [ring.astype(np.int32) for ring in rings], 255)  # even-odd: holes stay black
        picture |= filled
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), picture[::-1])
