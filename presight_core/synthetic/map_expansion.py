"""The vector map of a city in the nuScenes map-expansion format, version 1.3."""

import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from shapely.geometry import LineString, Point, Polygon
from shapely.ops import substring, unary_union

from presight_core.synthetic.arclines import fit_arcs, row_from_arc
from presight_core.synthetic.city import City
from presight_core.synthetic.files import write_json
from presight_core.synthetic.graph import LANE_WIDTH_M, PARKING_WIDTH_M, Edge, StreetGraph
from presight_core.synthetic.layers import BAY_LENGTH_M, SNAP_M, Lane, polygons
from presight_core.synthetic.nuscenes import Row, Rows, token

VERSION = "1.3"
NODE_GAP_M = 4.0  # readers look for lines in a region by their nodes, so no line may leap over one
SEAM_M = 0.02  # how far a junction reaches into its streets: no slit remains that would look like a curb
TABLES = (
    "polygon", "line", "node", "drivable_area", "road_segment", "road_block", "lane", "ped_crossing", "walkway",
    "stop_line", "carpark_area", "road_divider", "lane_divider", "traffic_light", "lane_connector",
)  # fmt: skip


def write_map_expansion(path: Path, city: City) -> None:
    """Write the map of a city to `maps/expansion/<location>.json`; its location is the file's name."""
    write_json(path, map_expansion(city, path.stem))


def map_expansion(city: City, location: str) -> dict[str, Any]:
    """All tables of the map; coordinates are world metres, rounded to millimetres."""
    return _MapBuilder(city, location).build()


def turn_centre(graph: StreetGraph, path: tuple[int, int, int], lane: int, ends: NDArray) -> NDArray[np.float64]:
    """The line (N, 2) that cars follow through the middle node of a path, between two ends (2, 2) on it."""
    route = LineString(graph.route(list(path), lane))
    start_m, end_m = (route.project(Point(end)) for end in ends)
    ease_m = min(2.5, (end_m - start_m) / 4)  # 2.5: routes are smoothed over 4.5 m, so they may miss the ends by a bit
    inner = substring(route, start_m + ease_m, end_m - ease_m)
    return np.concatenate([ends[:1], np.asarray(inner.coords), ends[1:]])


class _MapBuilder:
    """A map in the making; streets, blocks and lanes have tokens that follow from where they are in the graph."""

    def __init__(self, city: City, location: str):
        self.city, self.layers, self.graph = city, city.layers, city.graph
        self.location = location
        self.tables: Rows = {table: [] for table in TABLES}
        self.nodes: dict[tuple[int, int], str] = {}  # by millimetres: lines and polygons that touch share nodes
        self.paths: dict[str, list[Row]] = {}
        self.connectivity: dict[str, dict[str, list[str]]] = {}
        self.paints = [shapely.STRtree(paint) for paint in (self.layers.white_paint, self.layers.yellow_paint)]
        crossings = [polygon for polygon, _ in self.layers.crossings]
        self.crossed = unary_union(crossings).buffer(1.6)  # metres; up to the back of the stop line

    def build(self) -> dict[str, Any]:
        self._add_areas()
        self._add_lanes()
        self._add_blocks()
        self._add_crossings()
        self._add_stop_lines()
        self._add_dividers()
        self._add_parking()
        self._add_connectors()
        edge_m = float(self.city.style.size_m)
        return {
            "version": VERSION,
            "canvas_edge": [edge_m, edge_m],
            **self.tables,
            "arcline_path_3": self.paths,
            "connectivity": self.connectivity,
        }

    # ---- geometry ------------------------------------------------------------------------------------------------

    def _name(self, *parts: object) -> str:
        return token(self.location, *parts)

    def _node(self, point: NDArray[np.float64]) -> str:
        x_mm, y_mm = (round(float(value) * 1000) for value in point)
        if (x_mm, y_mm) not in self.nodes:
            self.nodes[x_mm, y_mm] = self._name("node", x_mm, y_mm)
            self.tables["node"].append({"token": self.nodes[x_mm, y_mm], "x": x_mm / 1000, "y": y_mm / 1000})
        return self.nodes[x_mm, y_mm]

    def _trace(self, points: ArrayLike) -> list[str]:
        """Nodes along a polyline, no farther apart than the format demands."""
        dense = shapely.segmentize(LineString(np.asarray(points)), NODE_GAP_M - 0.002)  # 2 mm: nodes are rounded
        return [name for name, _ in itertools.groupby(map(self._node, np.asarray(dense.coords)))]

    def _line(self, points: ArrayLike) -> str:
        name = self._name("line", len(self.tables["line"]))
        self.tables["line"].append({"token": name, "node_tokens": self._trace(points)})
        return name

    def _polygon(self, polygon: Polygon) -> str:
        polygon = shapely.geometry.polygon.orient(polygon)
        name = self._name("polygon", len(self.tables["polygon"]))
        row = {
            "token": name,
            "exterior_node_tokens": self._ring(polygon.exterior),
            "holes": [{"node_tokens": self._ring(hole)} for hole in polygon.interiors],
        }
        self.tables["polygon"].append(row)
        return name

    def _ring(self, ring: shapely.LinearRing) -> list[str]:
        names = [name for name, _ in itertools.groupby(map(self._node, np.asarray(ring.coords)))]
        return names[:-1]  # the format closes rings by itself

    # ---- areas ---------------------------------------------------------------------------------------------------

    def _segment(self, edge: Edge) -> str:
        return self._name("road_segment", *edge)

    def _block(self, edge: Edge, forward: bool) -> str:
        return self._name("road_block", *edge, forward)

    def _add_areas(self) -> None:
        drivable = self._name("drivable_area")
        parts = [self._polygon(polygon) for polygon in self.layers.drivable]
        self.tables["drivable_area"] = [{"token": drivable, "polygon_tokens": parts}]
        for polygon, edge in self.layers.segments:
            self._add_segment(self._segment(edge), polygon, False)
        junctions = [Point(place) for node, place in enumerate(self.graph.nodes) if self.graph.is_junction(node)]
        for number, polygon in enumerate(self.layers.intersections):
            reaching = polygons(polygon.buffer(SEAM_M, join_style="mitre").intersection(self.layers.road))
            whole = max(reaching, key=lambda part: part.area)
            is_junction = any(polygon.contains(place) for place in junctions)  # else: a bend
            self._add_segment(self._name("road_segment", "node", number), whole, is_junction)
        for number, polygon in enumerate(self.layers.walkway):
            row = {"token": self._name("walkway", number), "polygon_token": self._polygon(polygon)}
            self.tables["walkway"].append(row)

    def _add_segment(self, name: str, polygon: Polygon, is_junction: bool) -> None:
        row = {
            "token": name,
            "polygon_token": self._polygon(polygon),
            "is_intersection": is_junction,
            "drivable_area_token": self._name("drivable_area"),
        }
        self.tables["road_segment"].append(row)

    def _add_parking(self) -> None:
        outline = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [BAY_LENGTH_M / 2, PARKING_WIDTH_M / 2]
        beside = shapely.STRtree([lane.polygon for lane in self.layers.lanes])
        for number, (x, y, yaw_rad) in enumerate(self.layers.parking):
            c, s = np.cos(yaw_rad), np.sin(yaw_rad)
            corners = outline @ np.array([[c, s], [-s, c]]) + [x, y]
            nearest = self.layers.lanes[int(beside.nearest(Point(x, y)))]
            row = {
                "token": self._name("carpark_area", number),
                "polygon_token": self._polygon(Polygon(corners)),
                "orientation": yaw_rad,
                "road_block_token": self._block(nearest.edge, nearest.forward),
            }
            self.tables["carpark_area"].append(row)

    # ---- lanes ---------------------------------------------------------------------------------------------------

    def _lane(self, lane: Lane) -> str:
        return self._name("lane", *lane.edge, lane.forward, lane.number)

    def _add_lanes(self) -> None:
        for lane in self.layers.lanes:
            row = {
                "token": self._lane(lane),
                "polygon_token": self._polygon(lane.polygon),
                "lane_type": "CAR",
                **self._edges(lane.left, lane.right),
                "left_lane_divider_segments": self._divider(lane.left),
                "right_lane_divider_segments": self._divider(lane.right),
            }
            self.tables["lane"].append(row)
            self._add_path(row["token"], lane.centre)

    def _edges(self, left: NDArray[np.float64], right: NDArray[np.float64]) -> Row:
        """The lines across the begin and the end of a lane or block."""
        return {
            "from_edge_line_token": self._line([left[0], right[0]]),
            "to_edge_line_token": self._line([left[-1], right[-1]]),
        }

    def _divider(self, points: NDArray[np.float64]) -> list[Row]:
        kind = self._marking(LineString(points))
        return [{"node_token": node, "segment_type": kind} for node in self._trace(points)]

    def _marking(self, line: LineString) -> str:
        """What is painted along a line, told by its mean width away from crossings.

        The format knows neither double yellow nor single dashed white lines: these get the nearest name that it has.
        """
        strip = line.buffer(0.25, cap_style="flat").difference(self.crossed)  # 0.25: both halves of a double line
        length_m = strip.area / 0.5
        white_m, yellow_m = (
            float(shapely.area(shapely.intersection(strip, tree.geometries[tree.query(strip)])).sum()) / length_m
            for tree in self.paints
        )
        if yellow_m > 0.04:  # half of what dashes have
            return "SINGLE_SOLID_YELLOW"
        limits_m = (0.04, 0.10, 0.20)  # solid lines are 0.14 wide, dashes take half of that, double lines twice
        kinds = "NIL", "DOUBLE_DASHED_WHITE", "SINGLE_SOLID_WHITE", "DOUBLE_SOLID_WHITE"
        return kinds[int(np.searchsorted(limits_m, white_m))]

    def _add_path(self, name: str, centre: NDArray[np.float64], ends_rad: tuple[float, float] | None = None) -> None:
        self.paths[name] = [row_from_arc(arc) for arc in fit_arcs(centre, ends_rad)]
        self.connectivity[name] = {"incoming": [], "outgoing": []}

    def _add_blocks(self) -> None:
        """All lanes of one direction of a street make a block."""
        for (edge, forward), group in itertools.groupby(self.layers.lanes, lambda lane: (lane.edge, lane.forward)):
            lanes = sorted(group, key=lambda lane: lane.number, reverse=self.graph.drive_side > 0)  # from the left
            left, right = lanes[0].left, lanes[-1].right
            row = {
                "token": self._block(edge, forward),
                "polygon_token": self._polygon(Polygon(np.concatenate([left, right[::-1]]))),
                **self._edges(left, right),
                "road_segment_token": self._segment(edge),
            }
            self.tables["road_block"].append(row)

    def _add_connectors(self) -> None:
        """The ways through every node, lane by lane as traffic takes them."""
        lanes = {(lane.edge, lane.forward, lane.number): lane for lane in self.layers.lanes}

        def lane_of(a: int, b: int, number: int) -> Lane:
            edge = self.graph.edge(a, b)
            return lanes[edge, edge == (a, b), min(number, self.graph.lanes(a, b) - 1)]

        for node, others in self.graph.neighbours.items():
            for before, after in itertools.permutations(sorted(others), 2):
                path = before, node, after
                for number in range(max(self.graph.lanes(before, node), self.graph.lanes(node, after))):
                    self._connect(path, number, lane_of(before, node, number), lane_of(node, after, number))

    def _connect(self, path: tuple[int, int, int], number: int, before: Lane, after: Lane) -> None:
        ends = np.stack([before.centre[-1], after.centre[0]])
        centre = turn_centre(self.graph, path, number, ends)
        ribbon = LineString(centre).buffer(LANE_WIDTH_M / 2, cap_style="flat").simplify(SNAP_M)
        surface = max(polygons(ribbon), key=lambda part: part.area)  # a tight bend may shed a crumb
        name = self._name("lane_connector", *path, number)
        self.tables["lane_connector"].append({"token": name, "polygon_token": self._polygon(surface)})
        headings = self.paths[self._lane(before)][-1]["end_pose"][2], self.paths[self._lane(after)][0]["start_pose"][2]
        self._add_path(name, centre, headings)
        for first, second in itertools.pairwise((self._lane(before), name, self._lane(after))):
            self.connectivity[first]["outgoing"].append(second)
            self.connectivity[second]["incoming"].append(first)

    # ---- markings ------------------------------------------------------------------------------------------------

    def _crossing(self, number: int) -> str:
        return self._name("ped_crossing", number)

    def _add_crossings(self) -> None:
        for number, (polygon, edge) in enumerate(self.layers.crossings):
            row = {
                "token": self._crossing(number),
                "polygon_token": self._polygon(polygon),
                "road_segment_token": self._segment(edge),
            }
            self.tables["ped_crossing"].append(row)

    def _add_stop_lines(self) -> None:
        """Every stop line has a crossing and a traffic light."""
        for number, (polygon, edge) in enumerate(self.layers.stop_lines):
            crossings = [
                (polygon.distance(other), n) for n, (other, e) in enumerate(self.layers.crossings) if e == edge
            ]
            arriving = min(
                (lane for lane in self.layers.lanes if lane.edge == edge),
                key=lambda lane: polygon.centroid.distance(lane.polygon),
            )
            light = self._name("traffic_light", number)
            block = self._block(edge, arriving.forward)
            row = {
                "token": self._name("stop_line", number),
                "polygon_token": self._polygon(polygon),
                "stop_line_type": "TRAFFIC_LIGHT",
                "ped_crossing_tokens": [self._crossing(min(crossings)[1])],
                "traffic_light_tokens": [light],
                "road_block_token": block,
            }
            self.tables["stop_line"].append(row)
            self.tables["traffic_light"].append(self._light(light, block, polygon, arriving))

    def _light(self, name: str, block: str, stop_line: Polygon, lane: Lane) -> Row:
        """The lamp over the lane: beside the stop line stands a mast whose arm reaches back over it."""
        middle = np.array(stop_line.centroid.coords[0])
        centre = lane.centre
        step = int(np.linalg.norm(centre[:-1] + centre[1:] - 2 * middle, axis=1).argmin())  # the stretch beside it
        heading = (centre[step + 1] - centre[step]) / np.linalg.norm(centre[step + 1] - centre[step])
        outward = self.graph.drive_side * np.array([-heading[1], heading[0]])
        across_m = self.graph.half_width_m(*lane.edge) / 2 + 0.5 - 3.2  # mast half a metre behind the curb, arm 3.2 m
        place = middle + across_m * outward
        yaw_rad = float(np.arctan2(-heading[1], -heading[0]))
        ground_m = self.city.height_m(*place)
        return {
            "token": name,
            "line_token": self._line([place, place - heading]),  # from the lamp, the way it shines
            "traffic_light_type": "VERTICAL",
            "from_road_block_token": block,
            "items": [_lamp(colour, (1 - n) * 0.33) for n, colour in enumerate(("RED", "YELLOW", "GREEN"))],
            "pose": _pose((*place.tolist(), ground_m + 5.3), yaw_rad),  # 5.3: middle of the housing
        }

    def _add_dividers(self) -> None:
        for number, (points, edge) in enumerate(self.layers.road_dividers):
            row = {
                "token": self._name("road_divider", number),
                "line_token": self._line(points),
                "road_segment_token": self._segment(edge),
            }
            self.tables["road_divider"].append(row)
        for number, (points, _) in enumerate(self.layers.lane_dividers):
            row = {
                "token": self._name("lane_divider", number),
                "line_token": self._line(points),
                "lane_divider_segments": self._divider(points),
            }
            self.tables["lane_divider"].append(row)


def _pose(place: Iterable[float], yaw_rad: float = 0.0) -> Row:
    return dict(zip(("tx", "ty", "tz", "rx", "ry", "rz"), (*place, 0.0, 0.0, yaw_rad), strict=True))


def _lamp(colour: str, above_m: float) -> Row:
    """One lens of a traffic light, relative to its middle."""
    return {"color": colour, "shape": "CIRCLE", "rel_pos": _pose((0.0, 0.0, above_m)), "to_road_block_tokens": []}
