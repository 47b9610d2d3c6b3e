"""What is known of the ground, on the card: the same stretches as `Ground`, from a map instead of a search."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from presight_core.config import GroundSettings
from presight_core.field.tile_field import Rays
from stages.camera_heights import CameraHeights
from stages.ground import GROUND, MIN_CAMERA_M, MIN_DESCENT, SIDEWALK

CELL_M = 0.5  # on a street that rises by a tenth, heights are then right to 5 cm, half of the usual tolerance
ROWS_AT_ONCE = 256  # of the map while it is drawn: a few hundred thousand searches, 100 MB


class CardGround:
    """A map of the heights of the nearest cameras; infinite where no camera is near."""

    def __init__(
        self, positions_world: NDArray[np.float64], origin_m: NDArray[np.float64], settings: GroundSettings, device: str
    ) -> None:
        """Cameras (N, 3) in the world, and the origin of the field's frame there."""
        self._settings = settings
        low = positions_world.min(0)[:2] - settings.reach_m
        size = np.ceil((positions_world.max(0)[:2] + settings.reach_m - low) / CELL_M).astype(int)
        heights = CameraHeights(positions_world)
        x_m, y_m = (low[axis] + (np.arange(size[axis]) + 0.5) * CELL_M for axis in range(2))
        cameras_m = np.full((size[1], size[0]), np.inf, np.float32)
        for first in range(0, size[1], ROWS_AT_ONCE):
            rows = slice(first, first + ROWS_AT_ONCE)
            places = np.stack(np.meshgrid(x_m, y_m[rows]), -1).reshape(-1, 2)
            height_m, distance_m = heights.nearest(places)
            height_m = np.where(distance_m < settings.reach_m, height_m - origin_m[2], np.inf)
            cameras_m[rows] = height_m.reshape(-1, size[0])
        self._cameras_m = torch.from_numpy(cameras_m).to(device)
        self._low = torch.from_numpy((low - origin_m[:2]).astype(np.float32)).to(device)
        self._is_ground = torch.from_numpy(GROUND).to(device)

    def stretches(self, rays: Rays, labels: Tensor) -> tuple[Tensor, Tensor]:
        """Start and end (R,), metres, of where each ray may end; 0 and inf where nothing is known.

        Of static shapes: every ray is followed to the ground, and the answers that mean nothing are dropped.
        """
        settings, drop = self._settings, -rays.directions[:, 2]
        steep = drop.clamp_min(MIN_DESCENT)
        landing = rays.origins + (settings.camera_height_m / steep)[:, None] * rays.directions
        cameras_m = self._at(landing)
        above_m = rays.origins[:, 2] - cameras_m + settings.camera_height_m  # of the ray's origin
        known = self._is_ground[labels.long()] & (drop > MIN_DESCENT) & (above_m > MIN_CAMERA_M)
        higher_m = settings.tolerance_m + settings.curb_m * (labels == SIDEWALK)
        start_m = (above_m - higher_m).clamp_min(0) / steep
        end_m = (above_m + settings.tolerance_m) / steep
        return torch.where(known, start_m, 0), torch.where(known, end_m, torch.inf)

    def _at(self, points: Tensor) -> Tensor:
        """Height (R,) of the cameras nearest to points (R, 3); infinite where none is near."""
        column, row = ((points[:, :2] - self._low) / CELL_M).floor().long().unbind(-1)
        height, width = self._cameras_m.shape
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        found = self._cameras_m[row.clamp(0, height - 1), column.clamp(0, width - 1)]
        return torch.where(inside, found, torch.inf)
