"""Where rays must end that show the ground: roads have too little texture for a field to place them by itself.

A car stands on its road, so the road lies a camera's mounting height below the cameras that passed. A pixel that is
labelled road or sidewalk near such a place must end within a hand's breadth of that height.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from presight_core.classes import CITYSCAPES, lookup
from presight_core.config import GroundSettings
from stages.camera_heights import CameraHeights
from stages.ray_pool import PixelBatch

GROUND = lookup(("road", "sidewalk"))
SIDEWALK = CITYSCAPES.index("sidewalk")
MIN_CAMERA_M = 0.5  # a camera lower than this above what should be ground is on a bridge or a ramp: nothing is known
MIN_DESCENT = 0.02  # of a unit direction: flatter rays meet the ground beyond 75 m, where its height is a guess


class Stretches(NamedTuple):
    """Where rays may end, metres along them; 0 and inf where nothing is known."""

    start_m: NDArray[np.float32]  # (R,)
    end_m: NDArray[np.float32]  # (R,)


class Ground:
    """What the cameras of a tile tell about the height of the ground around them."""

    def __init__(self, positions_world: NDArray[np.float64], settings: GroundSettings) -> None:
        self._heights, self._settings = CameraHeights(positions_world), settings

    def stretches(self, batch: PixelBatch) -> Stretches:
        """The stretch of each ray that is as high as the ground must be."""
        settings, drop = self._settings, -batch.directions_world[:, 2]
        rows = np.flatnonzero(GROUND[batch.labels] & (drop > MIN_DESCENT))
        length_m = settings.camera_height_m / drop[rows]
        landing = batch.origins_world[rows] + length_m[:, None] * batch.directions_world[rows]
        cameras_m, distance_m = self._heights.nearest(landing)
        above_m = batch.origins_world[rows, 2] - cameras_m + settings.camera_height_m  # of the ray's origin
        known = (distance_m < settings.reach_m) & (above_m > MIN_CAMERA_M)
        rows, above_m = rows[known], above_m[known]
        higher_m = settings.tolerance_m + settings.curb_m * (batch.labels[rows] == SIDEWALK)
        start_m, end_m = np.zeros(len(drop), np.float32), np.full(len(drop), np.inf, np.float32)
        start_m[rows] = np.maximum(above_m - higher_m, 0) / drop[rows]
        end_m[rows] = (above_m + settings.tolerance_m) / drop[rows]
        return Stretches(start_m, end_m)
