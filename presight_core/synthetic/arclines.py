"""Arclines: a polyline as arcs and straights that touch smoothly, written as the Dubins paths of nuScenes maps."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

TOLERANCE_M = 0.05  # how far a fitted arc may pass from the points of its polyline
STRAIGHT_RAD = 1e-5  # an arc that turns less is a straight


@dataclass(frozen=True)
class Arc:
    """A stretch of constant curvature; zero curvature is a straight."""

    start: NDArray[np.float64]  # (2,)
    yaw_rad: float
    length_m: float
    curvature: float  # 1/m, positive to the left

    def at(self, along_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Poses (K, 3), x, y, yaw, at distances along the arc: a chord points half way between its ends' headings."""
        half_turn = 0.5 * self.curvature * along_m
        chord_m = along_m * np.sinc(half_turn / np.pi)
        towards = self.yaw_rad + half_turn
        offset = chord_m[:, None] * np.stack([np.cos(towards), np.sin(towards)], -1)
        return np.c_[self.start + offset, self.yaw_rad + 2 * half_turn]

    @property
    def end(self) -> NDArray[np.float64]:
        """The pose (3,) at the end."""
        return self.at(np.array([self.length_m]))[0]


def fit_arcs(points: NDArray[np.float64], ends_rad: tuple[float, float] | None = None) -> list[Arc]:
    """Arcs along a polyline (N, 2): each starts where, and in the direction in which, the one before it ends.

    Pairs of arcs span the polyline's halves, quarters and so on, until they pass all its points closely. `ends_rad`
    are the headings at both ends, for a line that continues others; without them the points decide.
    """
    along_m = np.r_[0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    tangents = np.gradient(points, along_m, axis=0, edge_order=1 if len(points) == 2 else 2)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    if ends_rad is not None:
        tangents[[0, -1]] = np.stack([np.cos(ends_rad), np.sin(ends_rad)], -1)
    return _fit(points, tangents)


def row_from_arc(arc: Arc) -> dict[str, Any]:
    """A row of `arcline_path_3`: a Dubins path, which turns, goes straight (or turns) and turns with one radius.

    Here two of its three stretches are empty.
    """
    is_straight = abs(arc.curvature) * arc.length_m < STRAIGHT_RAD
    return {
        "start_pose": [*arc.start.tolist(), arc.yaw_rad],
        "end_pose": arc.end.tolist(),
        "shape": "RSR" if arc.curvature < 0 and not is_straight else "LSL",
        "radius": 999.999 if is_straight else 1 / abs(arc.curvature),  # readers divide by the radius of straights too
        "segment_length": [0.0, arc.length_m, 0.0] if is_straight else [arc.length_m, 0.0, 0.0],
    }


def _fit(points: NDArray[np.float64], tangents: NDArray[np.float64]) -> list[Arc]:
    arcs = _span(points[[0, -1]], tangents[[0, -1]])
    if len(points) == 2 or _gap_m(arcs, points) < TOLERANCE_M:
        return arcs
    middle = len(points) // 2
    return _fit(points[: middle + 1], tangents[: middle + 1]) + _fit(points[middle:], tangents[middle:])


def _span(ends: NDArray[np.float64], tangents: NDArray[np.float64]) -> list[Arc]:
    """The two arcs (or one straight) that join two points with given unit tangents.

    The arcs meet where both end tangents, extended by the same reach, have their middle. The reach solves
    |chord - reach * (t1 + t2)| = 2 * reach; this form of the solution holds for parallel tangents too.
    """
    chord, both = ends[1] - ends[0], tangents.sum(0)
    square, ahead = chord @ chord, chord @ both
    reach = square / (ahead + np.sqrt(ahead**2 + 2 * (1 - tangents[0] @ tangents[1]) * square))
    joint = (ends.sum(0) + reach * (tangents[0] - tangents[1])) / 2
    yaw_rad = float(np.arctan2(tangents[0, 1], tangents[0, 0]))
    straight = _arc(ends[0], yaw_rad, ends[1])
    first = _arc(ends[0], yaw_rad, joint)
    second = _arc(joint, float(first.end[2]), ends[1])
    is_straight = max(abs(arc.curvature) * arc.length_m for arc in (first, second)) < STRAIGHT_RAD
    return [straight] if is_straight else [first, second]


def _arc(start: NDArray[np.float64], yaw_rad: float, end: NDArray[np.float64]) -> Arc:
    """The arc from a point with a heading to another point."""
    x, y = end - start
    chord_m = float(np.hypot(x, y))
    half_turn = (np.arctan2(y, x) - yaw_rad + np.pi) % (2 * np.pi) - np.pi
    return Arc(start, yaw_rad, chord_m / float(np.sinc(half_turn / np.pi)), float(2 * np.sin(half_turn)) / chord_m)


def _gap_m(arcs: list[Arc], points: NDArray[np.float64]) -> float:
    """The largest distance of a point from the arcs."""
    places = np.concatenate([arc.at(np.linspace(0, arc.length_m, 17))[:, :2] for arc in arcs])  # 17: chords off < 1 mm
    return float(shapely.distance(shapely.LineString(places), shapely.points(points)).max())
