"""True lines as the vector models learn them: a fixed number of points, in every order that is as good."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from presight_perception.map_truth import MAP_CLASSES, MapLines
from presight_perception.metrics.polyline import Polyline, resample
from presight_perception.models.bev_grid import BevGrid


@dataclass(frozen=True)
class LineSettings:
    """How lines become points."""

    point_count: int = 20
    # Orders of a closed line. turns: it begins at any of its points and runs either way (StreamMapNet).
    # vertices: it begins at any of the map's own vertices and keeps its direction (MapTR, second version).
    closed_orders: Literal["turns", "vertices"] = "turns"


class LineTruth(NamedTuple):
    """One sample's G lines."""

    labels: Tensor  # (G,) int64, places in MAP_CLASSES
    lines: Tensor  # (G, O, points, 2) float32 shares of the grid; orders fewer than O are repeated


def line_truth(lines: MapLines, grid: BevGrid, settings: LineSettings) -> LineTruth:
    """Lines in ego metres, by class, as points in all their orders."""
    orders = [orders_of(line, settings) for name in MAP_CLASSES for line in lines[name]]
    labels = [label for label, name in enumerate(MAP_CLASSES) for _ in lines[name]]
    most = max(map(len, orders), default=1)
    points = np.zeros((len(orders), most, settings.point_count, 2))
    for row, own in enumerate(orders):
        points[row] = own[np.arange(most) % len(own)]
    shares = grid.shares_from_metres(torch.from_numpy(points))
    return LineTruth(torch.tensor(labels, dtype=torch.int64), shares.float())


def orders_of(line: Polyline, settings: LineSettings) -> NDArray[np.float64]:
    """A line's points (O, points, 2) in every order; it is closed if its last vertex repeats the first."""
    count = settings.point_count
    if len(line) < 4 or not np.allclose(line[0], line[-1]):
        points = resample(line, count)
        return np.stack([points, points[::-1]])
    if settings.closed_orders == "turns":
        turned = _turned(resample(line, count)[:-1], np.arange(count - 1))
        return np.concatenate([turned, turned[:, ::-1]])
    corners = len(line) - 1
    starts = np.unique(np.linspace(0, corners, min(corners, count - 1), endpoint=False).astype(int))
    return np.stack([resample(turn, count) for turn in _turned(line[:-1], starts)])


def _turned(ring: NDArray[np.float64], starts: NDArray[np.int64]) -> NDArray[np.float64]:
    """A ring's points (V, 2), beginning and ending at each of the given ones: (S, V + 1, 2)."""
    rows = (starts[:, None] + np.arange(len(ring) + 1)) % len(ring)
    return ring[rows]
