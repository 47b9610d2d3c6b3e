"""The vector map: surfaces, markings and lanes of the streets, as polygons in world metres."""

from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from presight_core.synthetic.graph import LANE_WIDTH_M, Edge, Line, StreetGraph

WALKWAY_WIDTH_M = 3.2
CROSSING_DEPTH_M = 3.2
STOP_LINE_GAP_M = 1.2  # between crossing and stop line
SNAP_M = 0.03  # curves lose vertices closer to a chord than this; far below a pixel


@dataclass(frozen=True)
class Lane:
    """One lane between two junctions; lines run in its driving direction."""

    edge: Edge
    number: int  # 0: next to the street's axis
    forward: bool  # drives from edge[0] to edge[1]
    polygon: Polygon
    left: NDArray[np.float64]  # (2, 2)
    right: NDArray[np.float64]  # (2, 2)


@dataclass
class StreetLayers:
    """Everything painted or laid between the facades. Lists of (geometry, edge) keep the street they belong to."""

    road: BaseGeometry
    drivable: list[Polygon]
    walkway: list[Polygon]
    blocks: list[Polygon]
    crossings: list[tuple[Polygon, Edge]] = field(default_factory=list)
    stop_lines: list[tuple[Polygon, Edge]] = field(default_factory=list)
    segments: list[tuple[Polygon, Edge]] = field(default_factory=list)
    intersections: list[Polygon] = field(default_factory=list)
    lanes: list[Lane] = field(default_factory=list)
    road_dividers: list[tuple[NDArray[np.float64], Edge]] = field(default_factory=list)
    lane_dividers: list[tuple[NDArray[np.float64], Edge]] = field(default_factory=list)
    white_paint: list[Polygon] = field(default_factory=list)
    yellow_paint: list[Polygon] = field(default_factory=list)
    parking: list[tuple[float, float, float]] = field(default_factory=list)  # x, y, yaw of each bay


def polygons(geometry: BaseGeometry) -> list[Polygon]:
    """The polygons of a geometry, without slivers below a square centimetre."""
    return [part for part in shapely.get_parts(geometry) if isinstance(part, Polygon) and part.area > 1e-4]


def lay_streets(graph: StreetGraph, size_m: float) -> StreetLayers:
    """All street layers of a graph on a square map."""
    streets = [LineString(graph.nodes[list(edge)]).buffer(graph.half_width_m(*edge)) for edge in graph.edges]
    corner_m = 5.0  # curb radius at junctions
    road = unary_union(streets).buffer(corner_m, quad_segs=6).buffer(-corner_m, quad_segs=6).simplify(SNAP_M)
    with_walkway = road.buffer(WALKWAY_WIDTH_M, join_style="mitre")
    layers = StreetLayers(
        road=road,
        drivable=polygons(road),
        walkway=polygons(with_walkway.difference(road).simplify(SNAP_M)),
        blocks=_blocks(shapely.box(0, 0, size_m, size_m).difference(with_walkway)),
    )
    for edge in graph.edges:
        _lay_street(layers, graph, edge)
    between = road.difference(unary_union([polygon for polygon, _ in layers.segments]).buffer(0.01))
    layers.intersections = [polygon for polygon in polygons(between) if polygon.area > 30]  # less: a rounded corner
    return layers


def _blocks(ground: BaseGeometry) -> list[Polygon]:
    """The ground between streets, block by block; what lies around the outermost streets is cut into pieces."""
    blocks = []
    for part in polygons(ground):
        if not part.interiors:
            blocks.append(part)
            continue
        low_x, low_y, high_x, high_y = part.bounds
        cuts = np.linspace(0, 1, 4)  # three pieces a side
        for i, j in np.ndindex(3, 3):
            cell_x, cell_y = low_x + cuts[[i, i + 1]] * (high_x - low_x), low_y + cuts[[j, j + 1]] * (high_y - low_y)
            blocks += polygons(shapely.clip_by_rect(part, cell_x[0], cell_y[0], cell_x[1], cell_y[1]))
    return blocks


def _lay_street(layers: StreetLayers, graph: StreetGraph, edge: Edge) -> None:
    a, b = edge
    line, half_width = graph.line(a, b), graph.half_width_m(a, b)
    first, last = graph.mouth_m(a), line.length_m - graph.mouth_m(b)
    layers.segments.append((Polygon(line.strip((first, last), (-half_width, half_width))), edge))
    if graph.is_junction(a):
        incoming = (-graph.drive_side * half_width, 0.0)  # lanes that arrive at a
        first = _lay_crossing(layers, line, edge, (first, 1), half_width, incoming)
    if graph.is_junction(b):
        incoming = (0.0, graph.drive_side * half_width)
        last = _lay_crossing(layers, line, edge, (last, -1), half_width, incoming)
    layers.road_dividers.append((np.stack([line.at(first, 0), line.at(last, 0)]), edge))
    for left_m in (-0.16, 0.16):  # a double line
        layers.yellow_paint.append(Polygon(line.strip((first, last), (left_m - 0.07, left_m + 0.07))))
    for side in (-1, 1):
        _lay_lanes(layers, graph, edge, side, (first, last))


def _lay_crossing(
    layers: StreetLayers,
    line: Line,
    edge: Edge,
    mouth: tuple[float, int],  # where the street begins, and the direction into it
    half_width: float,
    incoming: tuple[float, float],  # across: the lanes that must stop
) -> float:
    """Zebra and stop line at one mouth of a street; returns where lane markings may begin."""
    start, into = mouth
    end = start + CROSSING_DEPTH_M * into
    layers.crossings.append((Polygon(line.strip((start, end), (0.2 - half_width, half_width - 0.2))), edge))
    for left_m in np.arange(0.6 - half_width, half_width - 0.6, 1.0):  # bars of half a metre
        layers.white_paint.append(Polygon(line.strip((start, end), (left_m, left_m + 0.5))))
    stop = end + STOP_LINE_GAP_M * into
    low, high = sorted(incoming)
    stop_line = Polygon(line.strip((stop, stop + 0.35 * into), (low + 0.2, high - 0.2)))
    layers.stop_lines.append((stop_line, edge))
    layers.white_paint.append(stop_line)
    return stop + 0.35 * into


def _lay_lanes(layers: StreetLayers, graph: StreetGraph, edge: Edge, side: int, along_m: tuple[float, float]) -> None:
    """Lanes, dividers and parking bays on one side (+1: left of the edge's direction)."""
    line, count = graph.line(*edge), graph.lanes(*edge)
    forward = side == graph.drive_side
    run = along_m if forward else along_m[::-1]
    for number in range(count):
        inner, outer = side * LANE_WIDTH_M * number, side * LANE_WIDTH_M * (number + 1)
        edges = [np.stack([line.at(s, across) for s in run]) for across in (inner, outer)]
        left, right = edges if graph.drive_side < 0 else edges[::-1]
        polygon = Polygon(line.strip(along_m, (inner, outer)))
        layers.lanes.append(Lane(edge, number, forward, polygon, left, right))
        if number > 0:
            layers.lane_dividers.append((np.stack([line.at(s, inner) for s in along_m]), edge))
            for s in np.arange(along_m[0] + 1, along_m[1] - 3, 6.0):  # 3 m dashes, 3 m gaps
                layers.white_paint.append(Polygon(line.strip((s, s + 3), (inner - 0.07, inner + 0.07))))
    if count == 1:
        _lay_parking(layers, line, edge, side, along_m, forward)


def _lay_parking(
    layers: StreetLayers, line: Line, edge: Edge, side: int, along_m: tuple[float, float], forward: bool
) -> None:
    """The line that divides lane and bays, ticks between the bays, and where cars stand."""
    border = side * LANE_WIDTH_M
    layers.lane_dividers.append((np.stack([line.at(s, border) for s in along_m]), edge))
    layers.white_paint.append(Polygon(line.strip(along_m, (border - 0.06, border + 0.06))))
    yaw_rad = line.yaw_rad + (0.0 if forward else np.pi)
    bay_m = 6.2
    for s in np.arange(along_m[0] + 3, along_m[1] - bay_m, bay_m):
        layers.white_paint.append(Polygon(line.strip((s - 0.05, s + 0.05), (border, border + side * 2.0))))
        x, y = line.at(s + bay_m / 2, border + side * 1.15)
        layers.parking.append((float(x), float(y), float(yaw_rad)))
