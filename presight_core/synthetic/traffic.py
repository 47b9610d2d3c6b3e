"""Traffic: who drives, stands and walks where, as functions of time."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from presight_core.synthetic.actor_shapes import KINDS
from presight_core.synthetic.actors import FIRST_ACTOR, Actor
from presight_core.synthetic.city import City
from presight_core.synthetic.graph import CLEAR_M, ROUTE_STEP_M, Edge
from presight_core.synthetic.roadworks import choose_works, things_on
from presight_core.synthetic.style import Density
from presight_core.synthetic.tracks import Colour, Crowd, Profile, Track, after_waiting, steady, with_stop

REACH_M = 130.0  # actors farther from the ego than this are not drawn
NEAR_M = 70.0  # rare things are put this close to the ego's way, so that they are seen
MEETING_M = 35.0  # who comes this close to the ego vehicle is well seen
CHECK_S = 0.25  # how often two tracks are compared
DRIVING_ROOM_M = (1.5, 0.4)  # between those who drive, lengthwise and sideways
STANDING_ROOM_M = (0.15, 0.12)  # from and between those who stand
CROSSING_ROOM_M = (2.0, 2.0)  # from those who walk across
AXLE_M = 1.4  # the ego pose is the rear axle's; this far ahead is the middle of the car
CURB_SHIFT_M = 1.2  # cyclists keep this far from the middle of their lane
PAINTS = (
    (0.70, 0.70, 0.70), (0.04, 0.04, 0.05), (0.30, 0.31, 0.33), (0.45, 0.04, 0.04), (0.04, 0.10, 0.35),
    (0.55, 0.53, 0.48), (0.03, 0.20, 0.11), (0.62, 0.45, 0.05),
)  # fmt: skip
DIGGER_PAINT = (0.62, 0.40, 0.03)
VEST = (0.75, 0.25, 0.03)


@dataclass(frozen=True)
class Traffic:
    """Everybody on the streets during one drive."""

    tracks: tuple[Track, ...]
    city: City

    def actors(self, time_s: float, near: NDArray[np.float64]) -> list[Actor]:
        """Who is within reach of a place (2,) at a moment."""
        poses = np.stack([track.poses(np.array([time_s]))[0] for track in self.tracks] or [np.zeros(3)])
        is_near = np.hypot(*(poses[:, :2] - near).T) < REACH_M
        grounds_m = self.city.surface_m(poses[:, 0], poses[:, 1])
        found = []
        for k in np.flatnonzero(is_near):
            track, (x, y, yaw) = self.tracks[k], poses[k].tolist()
            found.append(
                Actor(track.kind, x, y, yaw, track.colour, track.instance, float(grounds_m[k]), track.motion(time_s))
            )
        return found


def plan_traffic(
    city: City, rng: np.random.Generator, ego: NDArray[np.float64], duration_s: float, density: Density | None = None
) -> Traffic:
    """Traffic around an ego path, poses (T, 3) at equal intervals over the duration, that nobody collides with."""
    density = density or Density()
    times = np.linspace(0, duration_s, max(int(duration_s / CHECK_S), 1) + 1)
    spread = np.linspace(0, len(ego) - 1, len(times)).round().astype(int)
    planner = _Planner(city, rng, times, ego[spread])
    for _ in range(density.roadworks):
        planner.dig()
    planner.park(density.parked)
    for _ in range(density.bicycles):
        planner.leave_bicycles()
    kinds = ["cyclist"] * density.cyclists + ["motorcyclist"] * density.motorcyclists
    kinds += rng.choice(["car", "van", "truck", "bus"], density.vehicles, p=[0.68, 0.14, 0.10, 0.08]).tolist()
    for kind in kinds:
        planner.drive(kind, density.stopping)
    for _ in range(density.crossing):
        planner.cross()
    for _ in range(density.pedestrians):
        planner.walk()
    return Traffic(tuple(planner.tracks), city)


class _Planner:
    """Adds one road user at a time, and rejects those that would run into others."""

    def __init__(self, city: City, rng: np.random.Generator, times: NDArray, ego: NDArray):
        self.city, self.rng, self.times, self.ego = city, rng, times, ego
        self.tracks: list[Track] = []
        heading = np.c_[np.cos(ego[:, 2]), np.sin(ego[:, 2])]
        self._moving: list[tuple[NDArray, str]] = [(np.c_[ego[:, :2] + AXLE_M * heading, ego[:, 2]], "car")]
        self._standing: list[tuple[NDArray, str]] = []
        self._low, self._high = ego[:, :2].min(0) - REACH_M, ego[:, :2].max(0) + REACH_M

    # ---- those who stand ----

    def dig(self) -> None:
        """Roadworks on a street near the ego's way, on a free place."""
        edges = self._edges_nearby(6)
        if self.rng.random() < 0.6:  # rather where there are bays to close
            edges = sorted(edges, key=lambda edge: self.city.graph.lanes(*edge))
        for edge in edges:
            works = choose_works(self.city.graph, self.rng, edge, self.city.style.sidewalk_m)
            if works is None:
                continue
            things = things_on(works, self.city.graph, self.rng)
            if all(self._is_free(kind, np.array([pose]), STANDING_ROOM_M) for kind, *pose in things):
                for kind, *pose in things:
                    colour = {"digger": DIGGER_PAINT, "worker": VEST}.get(kind, (0.5, 0.5, 0.5))
                    self._stand(kind, colour, np.array([pose]))
                return

    def park(self, share: float) -> None:
        """Vehicles in this share of the bays; large ones may take two."""
        names = ["car", "van", "truck", "trailer", "motorcycle"]
        for bay in self.city.layers.parking:
            if self._is_near(bay) and self.rng.random() < share:
                pose = np.array([bay])
                pose[0, :2] += self.rng.normal(0, 0.1, 2)  # nobody parks exactly
                pose[0, 2] += self.rng.normal(0, 0.03)
                kind = str(self.rng.choice(names, p=[0.72, 0.14, 0.06, 0.03, 0.05]))
                if self._is_free(kind, pose, STANDING_ROOM_M):
                    self._stand(kind, self._paint(), pose)

    def leave_bicycles(self) -> None:
        """One to four bicycles in a row on the far side of a sidewalk."""
        graph, rng = self.city.graph, self.rng
        for edge in self._edges_nearby(1):
            street, side = graph.street(*edge), int(rng.choice([-1, 1]))
            left_m = side * (graph.half_width_m(*edge) + self.city.style.sidewalk_m - 0.5)
            first_m = rng.uniform(graph.mouth_m(edge[0]) + 4, street.length_m - graph.mouth_m(edge[1]) - 12)
            for along_m in first_m + 2.0 * np.arange(int(rng.integers(1, 5))):
                pose = np.array([[*street.at(along_m, left_m), street.yaw_at(along_m) + rng.normal(0, 0.08)]])
                if self._is_free("bicycle", pose, STANDING_ROOM_M):
                    self._stand("bicycle", self._paint(), pose)

    # ---- those who move ----

    def drive(self, kind: str, stopping: float) -> None:
        """Send somebody on wheels on a random route; after sixteen clashes they stay at home.

        Riders are few, so most of them are sent where the ego vehicle meets them."""
        graph, rng = self.city.graph, self.rng
        reach_m = NEAR_M if KINDS[kind].has_rider else REACH_M
        starts = [node for node, place in enumerate(graph.nodes) if self._is_near(place, reach_m)]
        speeds = (3.0, 5.0) if kind == "cyclist" else (5.0, 9.0)
        for attempt in range(16):
            path = graph.straightest_path(rng, int(rng.choice(starts or len(graph.nodes))), 6)
            lane = 1 if kind == "cyclist" else int(rng.integers(2))
            route = graph.route(path, lane)
            if kind == "cyclist":
                route = _shifted(route, CURB_SHIFT_M * graph.drive_side)
            profile = self._drive_along(route, path, rng.uniform(*speeds), KINDS[kind].length_m, stopping)
            if profile is None:
                continue
            track = Track(kind, self._paint(), self._next_instance(), route, profile)
            poses = track.poses(self.times)
            is_far = np.linalg.norm(poses[:, :2] - self.ego[:, :2], axis=1).min() > MEETING_M
            if KINDS[kind].has_rider and is_far and attempt < 10:
                continue
            if self._is_free(kind, poses, DRIVING_ROOM_M):
                self._add_moving(track, poses)
                return

    def _drive_along(
        self, route: NDArray[np.float64], path: Sequence[int], speed_mps: float, length_m: float, stopping: float
    ) -> Profile | None:
        """A profile that stays on the route, with a stop at a stop line or without; None if there is none."""
        rng, end_s = self.rng, float(self.times[-1])
        room_m = (len(route) - 1) * ROUTE_STEP_M - 3 - speed_mps * end_s
        if room_m <= 0:
            return None
        if rng.random() >= stopping:
            return steady(speed_mps, rng.uniform(0, room_m), end_s)
        places_m = self._stops_on(route, path) - length_m / 2 - 0.5  # the front half a metre before the line
        if not len(places_m):
            return None
        wait_s = rng.uniform(3, 9)
        arrival_s = rng.uniform(-0.8 * wait_s, max(0.8 * end_s, 0.1))
        profile = with_stop(speed_mps, float(rng.choice(places_m)), (arrival_s, arrival_s + wait_s), end_s)
        first_m, last_m = np.interp([0, end_s], *profile)
        return profile if first_m > 0 and last_m < (len(route) - 1) * ROUTE_STEP_M - 3 else None

    def _stops_on(self, route: NDArray[np.float64], path: Sequence[int]) -> NDArray[np.float64]:
        """Distances along a route to the stop lines before it."""
        graph, places = self.city.graph, []
        for edge in itertools.pairwise(path):
            for crossing in graph.crossings(*edge):
                if 1 in crossing.stops:
                    line = graph.street(*edge).at(crossing.middle_m - CLEAR_M, graph.lane_offset_m(*edge, 0))
                    places.append(np.argmin(np.linalg.norm(route - line, axis=1)) * ROUTE_STEP_M)
        return np.array(places)

    def cross(self) -> None:
        """A pedestrian who crosses a street when nobody comes."""
        graph, rng = self.city.graph, self.rng
        edges = [edge for edge in self._edges_nearby(8) if graph.crossings(*edge)]
        for edge in edges * 3:
            crossings = graph.crossings(*edge)
            along_m = crossings[int(rng.integers(len(crossings)))].middle_m + rng.uniform(-1.1, 1.1)
            half, side = graph.half_width_m(*edge) + 1.0, int(rng.choice([-1, 1]))
            steps = np.arange(0, 2 * half + 2.5, ROUTE_STEP_M)  # 2.5: something to look ahead to
            path = graph.street(*edge).at(np.full(len(steps), along_m), side * (steps - half))
            speed_mps, end_s = rng.uniform(1.0, 1.6), float(self.times[-1])
            profile = after_waiting(speed_mps, rng.uniform(-1.5 * half / speed_mps, max(end_s - 3, 0.0)), 2 * half)
            track = Track(self._pedestrian(), self._clothes(), self._next_instance(), path, profile)
            poses = track.poses(self.times)
            if self._is_free(track.kind, poses, CROSSING_ROOM_M):
                self._add_moving(track, poses)
                return

    def walk(self) -> None:
        """Put a pedestrian on a sidewalk near the ego: three of four walk, the others wait."""
        graph, rng = self.city.graph, self.rng
        near = [edge for edge in graph.edges if self._is_near(graph.nodes[list(edge)].mean(0))] or graph.edges
        edge = near[int(rng.integers(len(near)))]
        path = edge if rng.random() < 0.5 else edge[::-1]
        street, side = graph.street(*path), int(rng.choice([-1, 1]))
        across = side * (graph.half_width_m(*edge) + rng.uniform(1.4, self.city.style.sidewalk_m - 0.9))
        first, last = graph.mouth_m(path[0]) + 2, street.length_m - graph.mouth_m(path[1]) - 2
        points = street.at(np.arange(first, last, ROUTE_STEP_M), across)
        speed, end_s = float(rng.uniform(0.9, 1.6)), float(self.times[-1])
        room_m = (last - first) - 3 - speed * end_s
        kind, colour, instance = self._pedestrian(), self._clothes(), self._next_instance()
        if room_m > 0 and rng.random() < 0.75:
            track = Track(kind, colour, instance, points, steady(speed, rng.uniform(0, room_m), end_s))
        else:
            x, y = points[int(rng.integers(len(points)))]
            track = Track(kind, colour, instance, np.array([[x, y, rng.uniform(0, 2 * np.pi)]]))
        if not Crowd(*_stacked(self._standing)).meets(kind, track.poses(self.times), STANDING_ROOM_M):
            self.tracks.append(track)

    # ---- what they share ----

    def _stand(self, kind: str, colour: Colour, pose: NDArray[np.float64]) -> None:
        self.tracks.append(Track(kind, colour, self._next_instance(), pose))
        self._standing.append((pose, kind))

    def _add_moving(self, track: Track, poses: NDArray[np.float64]) -> None:
        self.tracks.append(track)
        self._moving.append((poses, track.kind))

    def _is_free(self, kind: str, poses: NDArray[np.float64], room_m: tuple[float, float]) -> bool:
        """Whether a way, or one pose, keeps clear of all others."""
        if Crowd(*_stacked(self._standing)).meets(kind, poses, STANDING_ROOM_M):
            return False
        return not Crowd(*_stacked(self._moving)).meets(kind, poses, room_m)

    def _next_instance(self) -> int:
        return FIRST_ACTOR + len(self.tracks)

    def _is_near(self, point: Sequence[float] | NDArray, reach_m: float = REACH_M) -> bool:
        spare_m = REACH_M - reach_m
        place = np.asarray(point)[:2]
        return bool((place > self._low + spare_m).all() and (place < self._high - spare_m).all())

    def _edges_nearby(self, count: int) -> list[Edge]:
        """Up to this many streets near the ego's way, in random order."""
        graph = self.city.graph
        near = [
            edge
            for edge in graph.edges
            if np.linalg.norm(graph.street(*edge).points[::10, None] - self.ego[::8, :2], axis=-1).min() < NEAR_M
        ]
        return [near[k] for k in self.rng.permutation(len(near))[:count]]

    def _pedestrian(self) -> str:
        return "child" if self.rng.random() < 0.15 else "pedestrian"

    def _clothes(self) -> Colour:
        red, green, blue = self.rng.uniform(0.03, 0.6, 3).tolist()
        return red, green, blue

    def _paint(self) -> Colour:
        base = np.array(PAINTS[int(self.rng.integers(len(PAINTS)))])
        red, green, blue = np.clip(base + self.rng.normal(0, 0.02, 3), 0.02, 0.8).tolist()
        return red, green, blue


def _stacked(taken: Sequence[tuple[NDArray, str]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses (K, T, 3) and sizes (K, 2) of a crowd."""
    if not taken:
        return np.zeros((0, 1, 3)), np.zeros((0, 2))
    sizes = [(KINDS[kind].length_m, KINDS[kind].width_m) for _, kind in taken]
    return np.stack([poses for poses, _ in taken]), np.array(sizes)


def _shifted(route: NDArray[np.float64], left_m: float) -> NDArray[np.float64]:
    """A route moved sideways."""
    step = np.gradient(route, axis=0)
    step /= np.linalg.norm(step, axis=1, keepdims=True)
    return route + left_m * np.c_[-step[:, 1], step[:, 0]]
