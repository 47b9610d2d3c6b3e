"""Distances between polylines."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Polyline = NDArray[np.float64]  # (V, 2) metres, V >= 2; closed if the last vertex repeats the first


def resample(line: Polyline, point_count: int) -> Polyline:
    """`point_count` points at equal steps of arc length, both ends included; a line of no length repeats its vertex."""
    line = np.asarray(line, np.float64)
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    wanted = np.linspace(0.0, travelled[-1], point_count)
    return np.stack([np.interp(wanted, travelled, line[:, axis]) for axis in range(2)], -1)


def chamfer_m(a: Polyline, b: Polyline) -> float:
    """Chamfer distance of points (N, 2) and (M, 2): the mean of both directed mean distances to the nearest."""
    distances = np.sqrt(((a[:, None] - b[None]) ** 2).sum(-1))
    return float(distances.min(1).mean() + distances.min(0).mean()) / 2


def chamfer_matrix_m(rows: Sequence[Polyline], columns: Sequence[Polyline], limit_m: float) -> NDArray[np.float64]:
    """Chamfer distances (R, C) of resampled lines; infinity where it certainly exceeds `limit_m`.

    A point is at least as far from a line as from the line's bounding box, which is quick to measure.
    """
    matrix = np.full((len(rows), len(columns)), np.inf)
    for i, a in enumerate(rows):
        for j, b in enumerate(columns):
            if (_mean_to_box(a, b) + _mean_to_box(b, a)) / 2 <= limit_m:
                matrix[i, j] = chamfer_m(a, b)
    return matrix


def _mean_to_box(points: Polyline, line: Polyline) -> float:
    """Mean distance of points to the bounding box of a line."""
    outside = np.maximum(np.maximum(line.min(0) - points, points - line.max(0)), 0.0)
    return float(np.hypot(outside[:, 0], outside[:, 1]).mean())
