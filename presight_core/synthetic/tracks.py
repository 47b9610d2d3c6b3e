"""Tracks: where one road user is at every moment, and whether two of them meet."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from presight_core.synthetic.actor_shapes import KINDS
from presight_core.synthetic.actors import Motion
from presight_core.synthetic.graph import follow

BRAKING, STARTING = 2.0, 1.5  # m/s^2: unhurried town driving
STEP_S = 0.05  # of integrated speeds
BEFORE_S = 1.0  # tracks begin earlier and end later than a drive: cameras fire a little off the keyframes
STANDING_MPS = 0.1  # slower is standing

Colour = tuple[float, float, float]
Profile = tuple[NDArray[np.float64], NDArray[np.float64]]  # times and distances along a path, both increasing


@dataclass(frozen=True)
class Track:
    """One road user: it moves along `path` as `profile` says, or stands at one pose."""

    kind: str
    colour: Colour
    instance: int
    path: NDArray[np.float64]  # (N, 2) points every half metre, or (1, 3) one pose
    profile: Profile | None = None

    @property
    def is_moving(self) -> bool:
        """Whether it moves at any time."""
        return self.profile is not None

    def poses(self, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """x, y, yaw (T, 3) at the given times."""
        if self.profile is None:
            return np.broadcast_to(self.path[0], (len(time_s), 3))
        return follow(self.path, np.interp(time_s, *self.profile))

    def motion(self, time_s: float) -> Motion:
        """What it does at a moment."""
        if self.profile is None:
            return "parked"
        before, after = np.interp([time_s - STEP_S, time_s + STEP_S], *self.profile)
        return "moving" if after - before > 2 * STEP_S * STANDING_MPS else "stopped"


def steady(speed_mps: float, start_m: float, end_s: float) -> Profile:
    """The same speed all the time; `start_m` is where time 0 finds it."""
    times = np.array([-BEFORE_S, end_s + BEFORE_S])
    return times, start_m + speed_mps * times


def with_stop(speed_mps: float, stop_m: float, stop_s: tuple[float, float], end_s: float) -> Profile:
    """Brakes to a stand at a place, waits there from one time to another, and drives on at the same speed."""
    arrival_s, departure_s = stop_s
    knots = [arrival_s - speed_mps / BRAKING, arrival_s, departure_s, departure_s + speed_mps / STARTING]
    times = np.arange(min(-BEFORE_S, knots[0]), max(end_s, arrival_s) + BEFORE_S + STEP_S, STEP_S)
    speeds = np.interp(times, knots, [speed_mps, 0, 0, speed_mps])
    along_m = np.r_[0, np.cumsum((speeds[1:] + speeds[:-1]) / 2 * STEP_S)]
    return times, along_m + stop_m - np.interp(arrival_s, times, along_m)


def after_waiting(speed_mps: float, departure_s: float, length_m: float) -> Profile:
    """Waits at the start of its path until a time, goes this far, and stands again."""
    times = departure_s + np.array([0.0, length_m / speed_mps])
    return times, np.array([0.0, length_m])


@dataclass(frozen=True)
class Crowd:
    """Boxes that move together in time: poses (K, T, 3), or (K, 1, 3) if they stand; length and width (K, 2)."""

    poses: NDArray[np.float64]
    sizes_m: NDArray[np.float64]

    def meets(self, kind: str, poses: NDArray[np.float64], room_m: tuple[float, float]) -> bool:
        """Whether a box of a kind on its way (T, 3) comes closer to any other than `room_m` (lengthwise, sideways).

        Two boxes are apart if an axis of either separates them.
        """
        size = np.array([KINDS[kind].length_m, KINDS[kind].width_m])
        gap = self.poses[..., :2] - poses[:, :2]
        turn = self.poses[..., 2] - poses[:, 2]
        cosine, sine = np.abs(np.cos(turn)), np.abs(np.sin(turn))
        sizes_m = self.sizes_m[:, None]
        mine = _is_within(gap, poses[:, 2], (cosine, sine), (size, sizes_m), room_m)
        theirs = _is_within(gap, self.poses[..., 2], (cosine, sine), (sizes_m, size), room_m)
        return bool((mine & theirs).any())


def _is_within(
    gap: NDArray,
    yaw: NDArray,
    turn: tuple[NDArray, NDArray],
    sizes: tuple[NDArray, NDArray],
    room_m: tuple[float, float],
) -> NDArray[np.bool_]:
    """Whether neither axis of the first box keeps the second at a distance."""
    (cosine, sine), (own, other) = turn, sizes
    ahead = np.abs(np.cos(yaw) * gap[..., 0] + np.sin(yaw) * gap[..., 1])
    aside = np.abs(np.cos(yaw) * gap[..., 1] - np.sin(yaw) * gap[..., 0])
    reach = (own[..., 0] + cosine * other[..., 0] + sine * other[..., 1]) / 2 + room_m[0]
    width = (own[..., 1] + sine * other[..., 0] + cosine * other[..., 1]) / 2 + room_m[1]
    return (ahead < reach) & (aside < width)
