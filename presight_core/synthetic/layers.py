"""The vector map: surfaces, markings and lanes of the streets, as polygons in world metres."""

from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, Point, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from presight_core.synthetic.graph import (
    CROSSING_DEPTH_M,
    LANE_WIDTH_M,
    STOP_LINE_DEPTH_M,
    STOP_LINE_GAP_M,
    Crossing,
    Edge,
    StreetGraph,
)
from presight_core.synthetic.street import Street
from presight_core.synthetic.style import CityStyle

BAY_LENGTH_M = 6.2  # of a parked car
SNAP_M = 0.03  # curves lose vertices closer to a chord than this; far below a pixel


@dataclass(frozen=True)
class Lane:
    """One lane between two junctions; lines run in its driving direction."""

    edge: Edge
    number: int  # 0: next to the street's axis
    forward: bool  # drives from edge[0] to edge[1]
    polygon: Polygon
    left: NDArray[np.float64]  # (N, 2)
    right: NDArray[np.float64]  # (N, 2)
    centre: NDArray[np.float64]  # (N, 2)


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


def lay_streets(graph: StreetGraph, style: CityStyle) -> StreetLayers:
    """All street layers of a graph on a square map."""
    streets = [
        LineString(graph.street(*edge).points).buffer(graph.half_width_m(*edge), cap_style="flat")
        for edge in graph.edges
    ]
    for node, place in enumerate(graph.nodes):  # fills the notch between flat ends without a bulge beyond a T
        streets.append(Point(place).buffer(min(graph.half_width_m(node, other) for other in graph.neighbours[node])))
    corner_m = 5.0  # curb radius at junctions
    road = unary_union(streets).buffer(corner_m, quad_segs=6).buffer(-corner_m, quad_segs=6).simplify(SNAP_M)
    with_walkway = road.buffer(style.sidewalk_m, quad_segs=4).simplify(
        SNAP_M
    )  # mitres would turn any notch into a spike
    layers = StreetLayers(
        road=road,
        drivable=polygons(road),
        walkway=polygons(with_walkway.difference(road).simplify(SNAP_M)),
        blocks=_blocks(shapely.box(0, 0, style.size_m, style.size_m).difference(with_walkway)),
    )
    for edge in graph.edges:
        _lay_street(layers, graph, style, edge)
    between = road.difference(unary_union([_strip(graph, edge, 0.3) for edge in graph.edges]))  # 0.3: up to any curb
    layers.intersections = [polygon for polygon in polygons(between) if polygon.area > 30]  # less: a rounded corner
    return layers


def _strip(graph: StreetGraph, edge: Edge, margin_m: float = 0.0) -> Polygon:
    """A street between its mouths, from curb to curb."""
    a, b = edge
    half, street = graph.half_width_m(a, b) + margin_m, graph.street(a, b)
    return Polygon(street.strip((graph.mouth_m(a), street.length_m - graph.mouth_m(b)), (-half, half)))


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


def _lay_street(layers: StreetLayers, graph: StreetGraph, style: CityStyle, edge: Edge) -> None:
    layers.segments.append((_strip(graph, edge), edge))
    for crossing in graph.crossings(*edge):
        _lay_crossing(layers, graph, edge, crossing)
    street, spans = graph.street(*edge), graph.free_spans_m(*edge)
    axis = layers.yellow_paint if style.is_axis_yellow else layers.white_paint
    for span in spans:
        layers.road_dividers.append((street.beside(span, 0.0), edge))
        if style.is_axis_dashed and graph.lanes(*edge) == 1:
            axis += _dashes(street, span, 0.0)
        else:
            axis += [Polygon(street.strip(span, (left - 0.07, left + 0.07))) for left in (-0.16, 0.16)]  # double
    for side in (-1, 1):
        _lay_lanes(layers, graph, edge, side)
        for span in spans:
            if graph.lanes(*edge) == 1:
                _lay_parking(layers, graph, edge, side, span)


def _dashes(street: Street, span_m: tuple[float, float], left_m: float) -> list[Polygon]:
    starts = np.arange(span_m[0] + 1, span_m[1] - 3, 6.0)  # 3 m dashes, 3 m gaps
    return [Polygon(street.strip((s, s + 3), (left_m - 0.07, left_m + 0.07))) for s in starts]


def _lay_crossing(layers: StreetLayers, graph: StreetGraph, edge: Edge, crossing: Crossing) -> None:
    """Zebra and stop lines."""
    street, half = graph.street(*edge), graph.half_width_m(*edge)
    along = crossing.middle_m - CROSSING_DEPTH_M / 2, crossing.middle_m + CROSSING_DEPTH_M / 2
    layers.crossings.append((Polygon(street.strip(along, (0.2 - half, half - 0.2))), edge))
    for left_m in np.arange(0.6 - half, half - 0.6, 1.0):  # bars of half a metre
        layers.white_paint.append(Polygon(street.strip(along, (left_m, left_m + 0.5))))
    for direction in crossing.stops:
        front = crossing.middle_m - direction * (CROSSING_DEPTH_M / 2 + STOP_LINE_GAP_M)
        back = front - direction * STOP_LINE_DEPTH_M
        low, high = sorted((0.0, direction * graph.drive_side * half))
        stop_line = Polygon(street.strip((back, front), (low + 0.2, high - 0.2)))
        layers.stop_lines.append((stop_line, edge))
        layers.white_paint.append(stop_line)


def _lay_lanes(layers: StreetLayers, graph: StreetGraph, edge: Edge, side: int) -> None:
    """Lanes and their dividers on one side (+1: left of the edge's direction)."""
    street, along_m = graph.street(*edge), graph.lane_span_m(*edge)
    forward = side == graph.drive_side
    run = along_m if forward else (along_m[1], along_m[0])
    for number in range(graph.lanes(*edge)):
        inner, centre, outer = (side * LANE_WIDTH_M * (number + share) for share in (0, 0.5, 1))
        lines = [street.beside(run, across) for across in (inner, outer)]
        left, right = lines if graph.drive_side < 0 else lines[::-1]
        polygon = Polygon(street.strip(along_m, (inner, outer)))
        layers.lanes.append(Lane(edge, number, forward, polygon, left, right, street.beside(run, centre)))
        if number > 0:
            for span in graph.free_spans_m(*edge):
                layers.lane_dividers.append((street.beside(span, inner), edge))
                layers.white_paint += _dashes(street, span, inner)


def _lay_parking(layers: StreetLayers, graph: StreetGraph, edge: Edge, side: int, span_m: tuple[float, float]) -> None:
    """Marks shaped like a T between the bays, and where cars stand. No line divides the bays from the lane."""
    street, border = graph.street(*edge), side * LANE_WIDTH_M
    turn_rad = 0.0 if side == graph.drive_side else np.pi
    starts = np.arange(span_m[0] + 3, span_m[1] - BAY_LENGTH_M, BAY_LENGTH_M)
    for s in starts:
        layers.white_paint.append(Polygon(street.strip((s - 0.06, s + 0.06), (border, border + side * 1.0))))
        layers.white_paint.append(Polygon(street.strip((s - 0.45, s + 0.45), (border, border - side * 0.12))))
        x, y = street.at(s + BAY_LENGTH_M / 2, border + side * 1.15)
        layers.parking.append((float(x), float(y), street.yaw_at(s + BAY_LENGTH_M / 2) + turn_rad))
