"""One street: a centre line that bends, and places beside it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

RADIUS_M = 35.0  # no street bends tighter
PIECE_M = 2.0  # edges along a bend are this long: less than 2 cm from the arc
STRAIGHT_M = 0.005  # what deviates less from its chord is drawn as one piece


@dataclass(frozen=True)
class Street:
    """The centre line from one node to another: points (N, 2) about a metre apart, their arc length, unit tangents."""

    points: NDArray[np.float64]  # (N, 2)
    along_m: NDArray[np.float64]  # (N,)
    tangents: NDArray[np.float64]  # (N, 2)

    @property
    def length_m(self) -> float:
        return float(self.along_m[-1])

    def at(self, along_m: ArrayLike, left_m: ArrayLike = 0.0) -> NDArray[np.float64]:
        """Points (..., 2) this far along the street and this far to its left."""
        frame = self._frame(along_m)
        return frame[..., :2] + np.asarray(left_m)[..., None] * _left_of(frame[..., 2:])

    def tangent_at(self, along_m: ArrayLike) -> NDArray[np.float64]:
        """Unit tangents (..., 2)."""
        return self._frame(along_m)[..., 2:]

    def left_at(self, along_m: ArrayLike) -> NDArray[np.float64]:
        """Unit normals (..., 2) to the left."""
        return _left_of(self.tangent_at(along_m))

    def yaw_at(self, along_m: float) -> float:
        """Heading in radians, counter-clockwise from east."""
        x, y = self.tangent_at(along_m)
        return float(np.arctan2(y, x))

    def beside(self, along_m: tuple[float, float], left_m: float) -> NDArray[np.float64]:
        """A line (N, 2) this far to the left: its two ends on a straight run, a point every two metres on a bend."""
        return self.at(self._steps(*along_m), left_m)

    def strip(self, along_m: tuple[float, float], left_m: tuple[float, float]) -> NDArray[np.float64]:
        """Corners (N, 2) of a band along the street; four on a straight run."""
        frame = self._frame(self._steps(*along_m))
        points, left = frame[:, :2], _left_of(frame[:, 2:])
        return np.concatenate([points + left_m[0] * left, (points + left_m[1] * left)[::-1]])

    def reversed(self) -> "Street":
        """The same street seen from its other end."""
        return Street(self.points[::-1], self.length_m - self.along_m[::-1], -self.tangents[::-1])

    @cached_property
    def _frames(self) -> NDArray[np.float64]:
        return np.concatenate([self.points, self.tangents], axis=1)

    def _frame(self, along_m: ArrayLike) -> NDArray[np.float64]:
        """Points and unit tangents (..., 4), between those that are known."""
        along_m = np.asarray(along_m, np.float64)
        after = np.clip(np.searchsorted(self.along_m, along_m), 1, len(self.along_m) - 1)
        start, end = self.along_m[after - 1], self.along_m[after]
        share = ((along_m - start) / (end - start))[..., None]
        frame = self._frames[after - 1] * (1 - share) + self._frames[after] * share
        frame[..., 2:] /= np.hypot(frame[..., 2], frame[..., 3])[..., None]
        return frame

    def _steps(self, start_m: float, end_m: float) -> NDArray[np.float64]:
        length_m = abs(end_m - start_m)
        pieces = 1
        if length_m**2 / (8 * RADIUS_M) > STRAIGHT_M:  # the sagitta of the tightest arc: then look at the true one
            tangents = self.tangent_at(np.linspace(start_m, end_m, int(length_m) + 2))
            turn = np.ptp(tangents @ _left_of(tangents[len(tangents) // 2]))  # sine of the angle
            pieces = max(2, int(np.ceil(length_m / PIECE_M))) if turn * length_m / 8 > STRAIGHT_M else 1
        return np.linspace(start_m, end_m, pieces + 1)


def _left_of(tangent: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([-tangent[..., 1], tangent[..., 0]], -1)


def bent_street(
    start: NDArray[np.float64], end: NDArray[np.float64], mouths_m: tuple[float, float], bulge_m: float
) -> Street:
    """A street that runs straight up to its mouths and between them swings out to the left by up to `bulge_m`.

    The bulge is a squared sine: it neither shifts nor turns the mouths. Its curvature is at most
    2 pi^2 bulge / room^2, so short streets bulge less.
    """
    length_m = float(np.linalg.norm(end - start))
    tangent = (end - start) / length_m
    room_m = length_m - sum(mouths_m)
    largest_m = room_m**2 / (2 * np.pi**2 * RADIUS_M)
    chord_m = np.linspace(0, length_m, int(np.ceil(length_m)) + 1)
    share = np.clip((chord_m - mouths_m[0]) / room_m, 0, 1)
    aside_m = np.clip(bulge_m, -largest_m, largest_m) * np.sin(np.pi * share) ** 2
    points = start + chord_m[:, None] * tangent + aside_m[:, None] * np.array([-tangent[1], tangent[0]])
    along_m = np.r_[0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    tangents = np.gradient(points, along_m, axis=0)
    return Street(points, along_m, tangents / np.linalg.norm(tangents, axis=1, keepdims=True))
