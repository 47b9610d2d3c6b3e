"""Roadworks: a few metres of a parking lane or a sidewalk, closed by cones and barriers."""

from dataclasses import dataclass

import numpy as np

from presight_core.synthetic.graph import LANE_WIDTH_M, Edge, StreetGraph

Standing = tuple[str, float, float, float]  # kind, x, y, yaw


@dataclass(frozen=True)
class Works:
    """Where a street is dug up."""

    edge: Edge
    side: int  # +1: left of the edge's direction
    along_m: tuple[float, float]
    left_m: tuple[float, float]  # distance from the axis, inner and outer border


def choose_works(graph: StreetGraph, rng: np.random.Generator, edge: Edge, sidewalk_m: float) -> Works | None:
    """A place for roadworks on a street; None if it is too short."""
    first, last = max(graph.free_spans_m(*edge), key=lambda span: span[1] - span[0])
    length_m = float(rng.uniform(9, 17))
    if last - first < length_m + 8:
        return None
    start = float(rng.uniform(first + 4, last - length_m - 4))
    curb_m = graph.half_width_m(*edge)
    on_sidewalk = graph.lanes(*edge) > 1 or rng.random() < 0.3
    inner, outer = (curb_m + 1.3, curb_m + sidewalk_m) if on_sidewalk else (LANE_WIDTH_M, curb_m)
    return Works(edge, int(rng.choice([-1, 1])), (start, start + length_m), (inner, outer))


def things_on(works: Works, graph: StreetGraph, rng: np.random.Generator) -> list[Standing]:
    """Cones along the open side, barriers at both ends, and somebody at work; often a digger."""
    street, (start, end), (inner, outer) = graph.street(*works.edge), works.along_m, works.left_m
    things: list[Standing] = []

    def put(kind: str, along_m: float, left_m: float, turn_rad: float = 0.0) -> None:
        x, y = street.at(along_m, works.side * left_m)
        things.append((kind, float(x), float(y), street.yaw_at(along_m) + turn_rad))

    for along_m in (start, end):
        put("barrier", along_m, (inner + outer) / 2 + 0.1)
    is_fenced = rng.random() < 0.4
    step_m = 3.0 if is_fenced else 2.4  # boards of 2 m: on the inside of a bend they come closer
    for along_m in np.arange(start + 1.5, end - 1.4, step_m):
        put("barrier" if is_fenced else "cone", along_m, inner + 0.15, np.pi / 2 if is_fenced else 0.0)
    spots = [end - 1.4, start + 1.4]
    if inner == LANE_WIDTH_M and end - start > 11 and rng.random() < 0.7:  # only the parking lane is wide enough
        put("digger", (start + end) / 2, outer - 0.95, np.pi * int(rng.integers(2)))
        spots.pop()
    for spot in spots:
        put("worker", spot, rng.uniform(inner + 0.9, outer - 0.3), rng.uniform(0, 2 * np.pi))
    return things
