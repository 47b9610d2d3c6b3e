"""The street graph: a jittered grid with missing edges, two- and four-lane streets that bend, and routes over it."""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from presight_core.synthetic.street import Street, bent_street
from presight_core.synthetic.style import CityStyle

LANE_WIDTH_M = 3.4  # urban lane
PARKING_WIDTH_M = 2.3
CROSSING_DEPTH_M = 3.2
STOP_LINE_GAP_M = 1.2  # between crossing and stop line
STOP_LINE_DEPTH_M = 0.35
CLEAR_M = CROSSING_DEPTH_M / 2 + STOP_LINE_GAP_M + STOP_LINE_DEPTH_M  # a crossing keeps lanes' markings this far off
ROUTE_STEP_M = 0.5  # spacing of the points of a route

Edge = tuple[int, int]


@dataclass(frozen=True)
class Crossing:
    """A pedestrian crossing of a street: where its middle lies along it, and who has a stop line before it."""

    middle_m: float
    stops: tuple[int, ...]  # +1: those who drive along the street, -1: those who drive against it


class StreetGraph:
    """Nodes (N, 2) in metres and the edges between them; `drive_side` is +1 for left-hand traffic, -1 for right."""

    def __init__(self, rng: np.random.Generator, style: CityStyle):
        self.drive_side = 1 if style.left_hand else -1
        self._columns = max(2, round((style.size_m - 2 * style.margin_m) / style.spacing_m) + 1)
        self.nodes = self._place_nodes(rng, style.size_m, style.margin_m)
        self.edges = self._choose_edges(rng)
        self.neighbours: dict[int, list[int]] = {node: [] for node in range(len(self.nodes))}
        for a, b in self.edges:
            self.neighbours[a].append(b)
            self.neighbours[b].append(a)
        self._lanes = {edge: 2 if self._is_major(edge) else 1 for edge in self.edges}
        self._mouths_m = [self._measure_mouth(node) for node in range(len(self.nodes))]
        self._streets = self._bend_streets(rng, style.bend_m)
        self._middle_crossings = self._cross_between_junctions(rng)

    def _bend_streets(self, rng: np.random.Generator, bend_m: float) -> dict[Edge, Street]:
        streets = {}
        for a, b in self.edges:
            bulge_m = bend_m * rng.uniform(0.35, 1) * rng.choice([-1, 1])
            mouths_m = self.mouth_m(a), self.mouth_m(b)
            streets[a, b] = bent_street(self.nodes[a], self.nodes[b], mouths_m, bulge_m)
            streets[b, a] = streets[a, b].reversed()
        return streets

    def _cross_between_junctions(self, rng: np.random.Generator) -> dict[Edge, float]:
        """Where streets are crossed between their ends: if no end is a junction, and now and then else."""
        places = {}
        for edge in self.edges:
            is_lonely = not any(self.is_junction(node) for node in edge)
            share, middle = rng.uniform(0.4, 0.6), rng.random() < 0.25
            if (is_lonely or middle) and self.street(*edge).length_m > 70:  # shorter: too close to the next
                places[edge] = share * self.street(*edge).length_m
        return places

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

    def street(self, a: int, b: int) -> Street:
        """The street seen from node a towards node b."""
        return self._streets[a, b]

    def crossings(self, a: int, b: int) -> list[Crossing]:
        """The crossings of a street, seen from node a towards node b."""
        length_m = self.street(a, b).length_m
        found = []
        if self.is_junction(a):
            found.append(Crossing(self.mouth_m(a) + CROSSING_DEPTH_M / 2, (-1,)))
        if (edge := self.edge(a, b)) in self._middle_crossings:
            middle_m = self._middle_crossings[edge]
            found.append(Crossing(middle_m if edge == (a, b) else length_m - middle_m, (1, -1)))
        if self.is_junction(b):
            found.append(Crossing(length_m - self.mouth_m(b) - CROSSING_DEPTH_M / 2, (1,)))
        return found

    def lane_span_m(self, a: int, b: int) -> tuple[float, float]:
        """Where the lanes of a street begin and end, seen from node a: beyond the stop lines at junctions."""
        first, last = (
            self.mouth_m(node) + (CROSSING_DEPTH_M / 2 + CLEAR_M if self.is_junction(node) else 0.0) for node in (a, b)
        )
        return first, self.street(a, b).length_m - last

    def free_spans_m(self, a: int, b: int) -> list[tuple[float, float]]:
        """The lanes' span without what a crossing in its midst takes."""
        first, last = self.lane_span_m(a, b)
        cuts = [crossing.middle_m for crossing in self.crossings(a, b) if len(crossing.stops) > 1]
        ends = [first, *(cut + side * CLEAR_M for cut in cuts for side in (-1, 1)), last]
        return list(zip(ends[::2], ends[1::2], strict=True))

    def lane_offset_m(self, a: int, b: int, lane: int) -> float:
        """How far to the left of the street's axis, seen from a, a lane towards b runs (0: next to the axis)."""
        return self.drive_side * LANE_WIDTH_M * (min(lane, self.lanes(a, b) - 1) + 0.5)

    def is_junction(self, node: int) -> bool:
        return len(self.neighbours[node]) > 2

    def mouth_m(self, node: int) -> float:
        """How far from a node's centre its streets begin: room for the corners, then crossings and stop lines."""
        return self._mouths_m[node]

    def _measure_mouth(self, node: int) -> float:
        others = self.neighbours[node]
        widest = max(self.half_width_m(node, other) for other in others)
        steps = self.nodes[others] - self.nodes[node]
        bearings = np.sort(np.arctan2(steps[:, 1], steps[:, 0]))
        sharpest = float(np.diff(bearings, append=bearings[0] + 2 * np.pi).min())
        meet_m = widest / np.tan(min(sharpest, np.pi / 2) / 2)  # where the curbs of two streets meet
        return meet_m + (4.5 if self.is_junction(node) else 1.5)  # 4.5: corner radius; 1.5: an easy bend

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
            heading = self.street(path[-2], path[-1]).tangents[-1]
            path.append(max(onward, key=lambda node: float(heading @ self.street(path[-1], node).tangents[0])))
        return path

    def route(self, path: list[int], lane: int = 0) -> NDArray[np.float64]:
        """Points (N, 2) every half metre along the middle of a lane (0: next to the street's axis) over a path."""
        legs = [self._leg(edge, lane) for edge in itertools.pairwise(path)]
        parts = [legs[0]]
        for k, (before, after) in enumerate(itertools.pairwise(legs)):
            parts += [self._bend(path[k : k + 3], before[-1], after[0]), after]
        return _resampled(np.concatenate(parts))

    def turn(self, path: tuple[int, int, int], lanes: tuple[int, int] = (0, 0)) -> NDArray[np.float64]:
        """The way (N, 2) across the middle node of a path: from the end of a lane to the start of a lane beyond."""
        a, node, b = path
        lane_end, lane_start = self.lane_span_m(a, node)[1], self.lane_span_m(node, b)[0]
        before = self.street(a, node).at(
            np.linspace(lane_end, self.street(a, node).length_m - self.mouth_m(node), 6),
            self.lane_offset_m(a, node, lanes[0]),
        )
        after = self.street(node, b).at(
            np.linspace(self.mouth_m(node), lane_start, 6), self.lane_offset_m(node, b, lanes[1])
        )
        points = np.concatenate([before, self._bend([a, node, b], before[-1], after[0]), after])
        return points[np.r_[True, np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-6]]  # joints come twice

    def _leg(self, edge: Edge, lane: int) -> NDArray[np.float64]:
        """Points of a lane's middle, a metre apart, between the mouths of a street."""
        street = self.street(*edge)
        start, end = self.mouth_m(edge[0]), street.length_m - self.mouth_m(edge[1])
        return street.at(np.linspace(start, end, int(end - start) + 2), self.lane_offset_m(*edge, lane))

    def _bend(self, path: list[int], end: NDArray[np.float64], start: NDArray[np.float64]) -> NDArray[np.float64]:
        """A quadratic Bezier curve over the middle node of a path that keeps both streets' headings."""
        heading, next_heading = self.street(*path[:2]).tangents[-1], self.street(*path[1:]).tangents[0]
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
    return np.column_stack([point(along_m), np.arctan2(ahead[:, 1], ahead[:, 0])])
