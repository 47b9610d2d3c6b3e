"""Traffic: who drives, stands and walks where, as functions of time."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from presight_core.synthetic.actors import FIRST_ACTOR, KINDS, Actor
from presight_core.synthetic.city import City
from presight_core.synthetic.graph import follow
from presight_core.synthetic.ground import Terrain
from presight_core.synthetic.style import Density

REACH_M = 130.0  # actors farther from the ego than this are not drawn
CHECK_S = 0.25  # how often two tracks are compared
PAINTS = (
    (0.70, 0.70, 0.70), (0.04, 0.04, 0.05), (0.30, 0.31, 0.33), (0.45, 0.04, 0.04), (0.04, 0.10, 0.35),
    (0.55, 0.53, 0.48), (0.03, 0.20, 0.11), (0.62, 0.45, 0.05),
)  # fmt: skip


@dataclass(frozen=True)
class Track:
    """One road user: it moves along `path` at a constant speed from `start_m`, or stands at its first pose."""

    kind: str
    colour: tuple[float, float, float]
    instance: int
    path: NDArray[np.float64]  # (N, 2) points every half metre, or (1, 3) one pose
    start_m: float = 0.0
    speed_mps: float = 0.0

    @property
    def is_moving(self) -> bool:
        return self.speed_mps > 0

    def poses(self, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """x, y, yaw (T, 3) at the given times."""
        if not self.is_moving:
            return np.repeat(self.path[:1, :3], len(time_s), 0)
        return follow(self.path, self.start_m + self.speed_mps * time_s)


@dataclass(frozen=True)
class Traffic:
    """Everybody on the streets during one drive."""

    tracks: tuple[Track, ...]
    terrain: Terrain

    @cached_property
    def moving(self) -> frozenset[int]:
        """Instances of those that move."""
        return frozenset(track.instance for track in self.tracks if track.is_moving)

    def actors(self, time_s: float, near: NDArray[np.float64]) -> list[Actor]:
        """Who is within reach of a place (2,) at a moment."""
        moment = np.array([time_s])
        found = []
        for track in self.tracks:
            x, y, yaw = (track.poses(moment) if track.is_moving else track.path)[0].tolist()
            if np.hypot(x - near[0], y - near[1]) < REACH_M:
                ground_m = float(self.terrain.height_m(x, y))
                found.append(Actor(track.kind, x, y, yaw, track.colour, track.instance, ground_m))
        return found


def plan_traffic(
    city: City, rng: np.random.Generator, ego: NDArray[np.float64], duration_s: float, density: Density | None = None
) -> Traffic:
    """Traffic around an ego path, poses (T, 3) at equal intervals over the duration, that nobody collides with."""
    density = density or Density()
    times = np.linspace(0, duration_s, max(int(duration_s / CHECK_S), 1) + 1)
    spread = np.linspace(0, len(ego) - 1, len(times)).round().astype(int)
    planner = _Planner(city, rng, times, ego[spread])
    planner.park(density.parked)
    kinds = ["cyclist"] * density.cyclists
    kinds += rng.choice(["car", "van", "truck", "bus"], density.vehicles, p=[0.68, 0.14, 0.10, 0.08]).tolist()
    for kind in kinds:
        planner.drive(kind)
    for _ in range(density.pedestrians):
        planner.walk()
    return Traffic(tuple(planner.tracks), city.terrain)


class _Planner:
    """Adds one road user at a time, and rejects those that would run into others."""

    def __init__(self, city: City, rng: np.random.Generator, times: NDArray, ego: NDArray):
        self.city, self.rng, self.times = city, rng, times
        self.tracks: list[Track] = []
        self._taken: list[tuple[NDArray, float]] = [(ego, KINDS["car"].length_m)]
        self._low, self._high = ego[:, :2].min(0) - REACH_M, ego[:, :2].max(0) + REACH_M

    def _add(self, track: Track) -> None:
        self.tracks.append(track)

    def _next_instance(self) -> int:
        return FIRST_ACTOR + len(self.tracks)

    def _is_near(self, point: Sequence[float] | NDArray) -> bool:
        return bool((np.asarray(point)[:2] > self._low).all() and (np.asarray(point)[:2] < self._high).all())

    def _paint(self) -> tuple[float, float, float]:
        base = np.array(PAINTS[int(self.rng.integers(len(PAINTS)))])
        red, green, blue = np.clip(base + self.rng.normal(0, 0.02, 3), 0.02, 0.8).tolist()
        return red, green, blue

    def park(self, share: float) -> None:
        for bay in self.city.layers.parking:
            if self._is_near(bay) and self.rng.random() < share:
                pose = np.array([bay])
                pose[0, :2] += self.rng.normal(0, 0.12, 2)  # nobody parks exactly
                pose[0, 2] += self.rng.normal(0, 0.03)
                kind = str(self.rng.choice(["car", "car", "car", "van"]))
                self._add(Track(kind, self._paint(), self._next_instance(), pose))

    def drive(self, kind: str) -> None:
        """Send a vehicle on a random route; after a dozen clashes it stays at home."""
        graph, rng = self.city.graph, self.rng
        starts = [node for node, place in enumerate(graph.nodes) if self._is_near(place)]
        for _ in range(12):
            path = graph.straightest_path(rng, int(rng.choice(starts)), 6)
            speed = rng.uniform(3.0, 5.0) if kind == "cyclist" else rng.uniform(5.0, 9.0)
            route = graph.route(path, lane=int(rng.integers(2)))
            if kind == "cyclist":  # keeps to the curb
                route = _shifted(route, 1.1 * graph.drive_side)
            room_m = len(route) / 2 - 3 - speed * self.times[-1]
            if room_m <= 0:
                continue
            track = Track(kind, self._paint(), self._next_instance(), route, rng.uniform(0, room_m), speed)
            poses = track.poses(self.times)
            if self._is_free(poses, KINDS[kind].length_m):
                self._taken.append((poses, KINDS[kind].length_m))
                self._add(track)
                return

    def _is_free(self, poses: NDArray[np.float64], length_m: float) -> bool:
        """Whether a path keeps clear of all others: lanes side by side pass, bumpers and crossings do not."""
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        for other, other_length_m in self._taken:
            dx, dy = (other[:, :2] - poses[:, :2]).T
            ahead, aside = np.abs(c * dx + s * dy), np.abs(c * dy - s * dx)
            reach_m = (length_m + other_length_m) / 2 + 1.5
            # Crossing traffic turns its length sideways.
            crossing = np.abs(np.sin(other[:, 2] - poses[:, 2])) * other_length_m / 2
            if bool(((ahead < reach_m) & (aside < 2.6 + crossing)).any()):
                return False
        return True

    def walk(self) -> None:
        """Put a pedestrian on a sidewalk near the ego: three of four walk, the others wait."""
        graph, rng = self.city.graph, self.rng
        near = [edge for edge in graph.edges if self._is_near(graph.nodes[list(edge)].mean(0))] or graph.edges
        edge = near[int(rng.integers(len(near)))]
        path = edge if rng.random() < 0.5 else edge[::-1]
        street = graph.street(*path)
        side = int(rng.choice([-1, 1]))
        across = side * (graph.half_width_m(*edge) + rng.uniform(1.5, 2.8))
        first, last = graph.mouth_m(path[0]) + 2, street.length_m - graph.mouth_m(path[1]) - 2
        clothes = rng.uniform(0.03, 0.6, 3)
        colour = (float(clothes[0]), float(clothes[1]), float(clothes[2]))
        points = street.at(np.arange(first, last, 0.5), across)
        speed = float(rng.uniform(0.9, 1.6))
        room_m = (last - first) - 3 - speed * self.times[-1]
        if room_m > 0 and rng.random() < 0.75:
            self._add(Track("pedestrian", colour, self._next_instance(), points, rng.uniform(0, room_m), speed))
            return
        x, y = points[int(rng.integers(len(points)))]
        pose = np.array([[x, y, rng.uniform(0, 2 * np.pi)]])
        self._add(Track("pedestrian", colour, self._next_instance(), pose))


def _shifted(route: NDArray[np.float64], left_m: float) -> NDArray[np.float64]:
    """A route moved sideways."""
    step = np.gradient(route, axis=0)
    step /= np.linalg.norm(step, axis=1, keepdims=True)
    return route + left_m * np.c_[-step[:, 1], step[:, 0]]
