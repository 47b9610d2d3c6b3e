"""The street graph: a jittered grid with missing edges, two- and four-lane streets, and routes over it."""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

LANE_WIDTH_M = 3.4  # urban lane
PARKING_WIDTH_M = 2.3
ROUTE_STEP_M = 0.5  # spacing of the points of a route

Edge = tuple[int, int]


@dataclass(frozen=True)
class Line:
    """A straight street from one node to another: origin (2,), unit tangent, unit left normal, length."""

    origin: NDArray[np.float64]
    tangent: NDArray[np.float64]
    left: NDArray[np.float64]
    length_m: float

    def at(self, along_m: float, left_m: float) -> NDArray[np.float64]:
        """The point (2,) this far along the street and this far to its left."""
        return self.origin + self.tangent * along_m + self.left * left_m

    def strip(self, along_m: tuple[float, float], left_m: tuple[float, float]) -> NDArray[np.float64]:
        """Corners (4, 2) of a rectangle along the street."""
        (a, b), (c, d) = along_m, left_m
        return np.stack([self.at(a, c), self.at(b, c), self.at(b, d), self.at(a, d)])

    @property
    def yaw_rad(self) -> float:
        return float(np.arctan2(self.tangent[1], self.tangent[0]))


class StreetGraph:
    """Nodes (N, 2) in metres and the edges between them; `drive_side` is +1 for left-hand traffic, -1 for right."""

    def __init__(self, rng: np.random.Generator, size_m: float, spacing_m: float, margin_m: float, left_hand: bool):
        self.drive_side = 1 if left_hand else -1
        self._columns = max(2, round((size_m - 2 * margin_m) / spacing_m) + 1)
        self.nodes = self._place_nodes(rng, size_m, margin_m)
        self.edges = self._choose_edges(rng)
        self.neighbours: dict[int, list[int]] = {node: [] for node in range(len(self.nodes))}
        for a, b in self.edges:
            self.neighbours[a].append(b)
            self.neighbours[b].append(a)
        self._lanes = {edge: 2 if self._is_major(edge) else 1 for edge in self.edges}

    def _place_nodes(self, rng: np.random.Generator, size_m: float, margin_m: float) -> NDArray[np.float64]:
        ticks = np.linspace(margin_m, size_m - margin_m, self._columns)
        grid = np.stack(np.meshgrid(ticks, ticks, indexing="ij"), -1).reshape(-1, 2)
        jitter = 0.13 * (ticks[1] - ticks[0])  # streets lean by up to 15 degrees and still cross well
        return grid + rng.uniform(-jitter, jitter, grid.shape)

    def _choose_edges(self, rng: np.random.Generator) -> list[Edge]:
        """All grid edges but about one in six; every node keeps two."""
        n = self._columns
        every = [(i * n + j, (i + 1) * n + j) for i in range(n - 1) for j in range(n)]
        every += [(i * n + j, i * n + j + 1) for i in range(n) for j in range(n - 1)]
        degree = np.bincount(np.ravel(every), minlength=n * n)
        kept = []
        for index in rng.permutation(len(every)):
            a, b = every[index]
            if rng.random() < 0.16 and degree[a] > 2 and degree[b] > 2:
                degree[[a, b]] -= 1
            else:
                kept.append((a, b))
        return sorted(kept)

    def _is_major(self, edge: Edge) -> bool:
        """Every third street of the grid has two lanes a direction."""
        a, b = edge
        n = self._columns
        line = a // n if a // n == b // n else a % n
        return line % 3 == 1

    def edge(self, a: int, b: int) -> Edge:
        """The edge between two neighbours as it is listed."""
        return (a, b) if (a, b) in self._lanes else (b, a)

    def lanes(self, a: int, b: int) -> int:
        """Lanes a direction: 1 (with parking on both sides) or 2."""
        return self._lanes[self.edge(a, b)]

    def half_width_m(self, a: int, b: int) -> float:
        """From the street's axis to its curb."""
        lanes = self.lanes(a, b)
        return lanes * LANE_WIDTH_M + (PARKING_WIDTH_M if lanes == 1 else 0.4)  # 0.4: gutter

    def line(self, a: int, b: int) -> Line:
        """The street seen from node a towards node b."""
        step = self.nodes[b] - self.nodes[a]
        length_m = float(np.linalg.norm(step))
        tangent = step / length_m
        return Line(self.nodes[a], tangent, np.array([-tangent[1], tangent[0]]), length_m)

    def is_junction(self, node: int) -> bool:
        return len(self.neighbours[node]) > 2

    def mouth_m(self, node: int) -> float:
        """How far from a node's centre its streets begin: room for the corners, then crossings and stop lines."""
        widest = max(self.half_width_m(node, other) for other in self.neighbours[node])
        return widest + 4.5 if self.is_junction(node) else 7.0  # 4.5: corner radius; 7: an easy bend

    def random_path(self, rng: np.random.Generator, start: int, nodes: int) -> list[int]:
        """A walk of `nodes` nodes that turns back only at dead ends."""
        path = [start, int(rng.choice(self.neighbours[start]))]
        while len(path) < nodes:
            onward = [node for node in self.neighbours[path[-1]] if node != path[-2]] or [path[-2]]
            path.append(int(rng.choice(onward)))
        return path

    def straightest_path(self, rng: np.random.Generator, start: int, nodes: int) -> list[int]:
        """A walk that leaves each junction in the straightest direction, as through traffic does."""
        path = self.random_path(rng, start, 2)
        while len(path) < nodes:
            onward = [node for node in self.neighbours[path[-1]] if node != path[-2]] or [path[-2]]
            heading = self.line(path[-2], path[-1]).tangent
            path.append(max(onward, key=lambda node: float(heading @ self.line(path[-1], node).tangent)))
        return path

    def route(self, path: list[int], lane: int = 0) -> NDArray[np.float64]:
        """Points (N, 2) every half metre along the middle of a lane (0: next to the street's axis) over a path."""
        legs = [self._leg(a, b, lane) for a, b in itertools.pairwise(path)]
        points = [legs[0][0]]
        for (_, end, heading), (start, _, next_heading) in itertools.pairwise(legs):
            points.extend(_bend(end, heading, start, next_heading))
        points.append(legs[-1][1])
        return _resampled(np.array(points))

    def _leg(self, a: int, b: int, lane: int) -> tuple[NDArray, NDArray, NDArray]:
        line = self.line(a, b)
        left_m = self.drive_side * LANE_WIDTH_M * (min(lane, self.lanes(a, b) - 1) + 0.5)
        start, end = line.at(self.mouth_m(a), left_m), line.at(line.length_m - self.mouth_m(b), left_m)
        return start, end, line.tangent


def _bend(end: NDArray, heading: NDArray, start: NDArray, next_heading: NDArray) -> NDArray[np.float64]:
    """Points of a quadratic Bezier curve from `end` to `start` that keeps both headings."""
    cross = heading[0] * next_heading[1] - heading[1] * next_heading[0]
    gap = start - end
    reach = (gap[0] * next_heading[1] - gap[1] * next_heading[0]) / cross if abs(cross) > 0.2 else 0.0
    control = end + heading * reach if reach > 0 else (end + start) / 2
    t = np.linspace(0, 1, 17)[:, None]
    return (1 - t) ** 2 * end + 2 * t * (1 - t) * control + t**2 * start


def _resampled(points: NDArray[np.float64]) -> NDArray[np.float64]:
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    points = points[np.r_[True, steps > 1e-6]]
    along = np.r_[0, np.cumsum(steps[steps > 1e-6])]
    targets = np.arange(0, along[-1], ROUTE_STEP_M)
    even = np.stack([np.interp(targets, along, points[:, axis]) for axis in (0, 1)], -1)
    window = 9  # points; 4.5 m of smoothing rounds the joints of straights and bends
    padded = np.pad(even, ((window // 2, window // 2), (0, 0)), mode="edge")
    kernel = np.ones(window) / window
    return np.stack([np.convolve(padded[:, axis], kernel, "valid") for axis in (0, 1)], -1)


def follow(route: NDArray[np.float64], along_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses (T, 3), x, y, yaw, of a vehicle at distances along a route; it looks two metres ahead."""

    def point(distance_m: NDArray) -> NDArray:
        before = np.minimum((distance_m / ROUTE_STEP_M).astype(np.int64), len(route) - 2)
        share = (distance_m / ROUTE_STEP_M - before)[:, None]
        return route[before] * (1 - share) + route[before + 1] * share

    last_m = (len(route) - 1) * ROUTE_STEP_M - 2.0  # beyond, there is no place to look ahead to
    along_m = np.clip(along_m, 0, last_m)
    ahead = point(along_m + 2.0) - point(along_m)
    return np.c_[point(along_m), np.arctan2(ahead[:, 1], ahead[:, 0])]
