"""The vector map: complete tables, sound geometry, a lane network that traffic can follow."""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import shapely
from shapely.geometry import LineString, Point, Polygon
from shapely.ops import unary_union

from presight_core.synthetic.arclines import Arc, fit_arcs, row_from_arc
from presight_core.synthetic.city import City
from presight_core.synthetic.map_expansion import NODE_GAP_M, TABLES, map_expansion, write_map_expansion
from presight_core.synthetic.style import CityStyle

BLOCK = CityStyle(size_m=200.0, spacing_m=90.0)  # four nodes: bends only


@pytest.fixture(scope="module", params=[True, False], ids=["left-hand", "right-hand"])
def city(request: pytest.FixtureRequest) -> City:
    """Nine nodes: junctions, crossings, both kinds of street."""
    return City(seed=1, style=CityStyle(size_m=260.0, spacing_m=75.0, left_hand=request.param))


@pytest.fixture(scope="module")
def tables(city: City) -> dict:
    return map_expansion(city, "boston-seaport")


class Geometry:
    """Reads lines and polygons back from the tables."""

    def __init__(self, tables: dict):
        self.places = {row["token"]: (row["x"], row["y"]) for row in tables["node"]}
        self.polygon_rows = {row["token"]: row for row in tables["polygon"]}
        self.line_rows = {row["token"]: row for row in tables["line"]}

    def points(self, nodes: list[str]) -> np.ndarray:
        return np.array([self.places[node] for node in nodes])

    def polygon(self, token: str) -> Polygon:
        row = self.polygon_rows[token]
        return Polygon(
            self.points(row["exterior_node_tokens"]), [self.points(hole["node_tokens"]) for hole in row["holes"]]
        )

    def line(self, token: str) -> LineString:
        return LineString(self.points(self.line_rows[token]["node_tokens"]))


@pytest.fixture(scope="module")
def geometry(tables: dict) -> Geometry:
    return Geometry(tables)


def poses_of(path: list[dict], step_m: float = 0.1) -> np.ndarray:
    """Poses (K, 3) along an arcline path, by small steps of a car that holds its curvature."""
    signs = {"LSL": (1, 0, 1), "RSR": (-1, 0, -1)}
    poses = []
    for row in path:
        pose = np.array(row["start_pose"])
        poses.append(pose)
        for length_m, sign in zip(row["segment_length"], signs[row["shape"]], strict=True):
            count = int(np.ceil(length_m / step_m))
            for _ in range(count):
                advance, turn = length_m / count, sign * length_m / count / row["radius"]
                heading = pose[2] + turn / 2
                pose = np.add(pose, [advance * np.cos(heading), advance * np.sin(heading), turn])
                poses.append(pose)
    return np.array(poses)


def ends_of(block: dict, geometry: Geometry) -> np.ndarray:
    """From the middle of a block's begin to the middle of its end (2, 2)."""
    return np.array([geometry.line(block[f"{end}_edge_line_token"]).centroid.coords[0] for end in ("from", "to")])


def test_every_reference_has_a_target(tables: dict):
    tokens = {table: {row["token"] for row in tables[table]} for table in TABLES}
    assert all(len(tokens[table]) == len(tables[table]) for table in TABLES)
    targets = {
        "polygon_token": "polygon", "line_token": "line", "from_edge_line_token": "line", "to_edge_line_token": "line",
        "road_segment_token": "road_segment", "road_block_token": "road_block", "node_tokens": "node",
        "from_road_block_token": "road_block", "drivable_area_token": "drivable_area", "polygon_tokens": "polygon",
        "ped_crossing_tokens": "ped_crossing", "traffic_light_tokens": "traffic_light", "node_token": "node",
        "exterior_node_tokens": "node", "to_road_block_tokens": "road_block",
    }  # fmt: skip
    checked = set()

    def check(value: object, field: str = "") -> None:
        if isinstance(value, dict):
            for name, content in value.items():
                check(content, name)
        elif isinstance(value, list):
            for content in value:
                check(content, field)
        elif field.endswith(("_token", "_tokens")):
            checked.add(field)
            assert value in tokens[targets[field]], field

    for table in TABLES:
        check(tables[table])
    assert checked == set(targets) - {"to_road_block_tokens"}  # lamps shine for all ways on


def test_every_node_serves_some_shape(tables: dict):
    text = json.dumps([tables[table] for table in TABLES if table != "node"])
    assert all(row["token"] in text for row in tables["node"])


def test_polygons_are_valid_and_lie_on_the_map(tables: dict, geometry: Geometry):
    canvas = shapely.box(0, 0, *tables["canvas_edge"])
    for row in tables["polygon"]:
        polygon = geometry.polygon(row["token"])
        assert polygon.is_valid
        assert polygon.area > 0.01
        assert canvas.contains(polygon)


def test_lines_have_nodes_close_enough_to_be_found(tables: dict, geometry: Geometry):
    for row in tables["line"]:
        steps = np.linalg.norm(np.diff(geometry.points(row["node_tokens"]), axis=0), axis=1)
        assert 0 < steps.min() <= steps.max() <= NODE_GAP_M


def test_road_segments_cover_the_road_without_slits(city: City, tables: dict, geometry: Geometry):
    whole = unary_union([geometry.polygon(row["polygon_token"]) for row in tables["road_segment"]])
    assert isinstance(whole, Polygon)  # a slit at a junction would read as a curb across the street
    assert whole.symmetric_difference(city.layers.road).area < 0.005 * city.layers.road.area
    assert len(whole.interiors) == sum(len(polygon.interiors) for polygon in city.layers.drivable)


def test_junctions_are_told_from_bends(city: City, tables: dict, geometry: Geometry):
    for row in tables["road_segment"]:
        polygon = geometry.polygon(row["polygon_token"])
        inside = [node for node, place in enumerate(city.graph.nodes) if polygon.contains(Point(place))]
        assert row["is_intersection"] == any(city.graph.is_junction(node) for node in inside)


def test_crossings_are_where_zebras_are_painted(city: City, tables: dict, geometry: Geometry):
    paint = unary_union(city.layers.white_paint)
    assert tables["ped_crossing"]
    for row in tables["ped_crossing"]:
        polygon = geometry.polygon(row["polygon_token"])
        assert 0.35 < paint.intersection(polygon).area / polygon.area < 0.65  # bars and gaps of equal width


def test_stop_lines_lie_before_their_crossing_and_light(tables: dict, geometry: Geometry):
    rows = {row["token"]: row for table in TABLES for row in tables[table]}
    for stop in tables["stop_line"]:
        block = rows[stop["road_block_token"]]
        line = geometry.polygon(stop["polygon_token"])
        assert geometry.polygon(block["polygon_token"]).distance(line) < 0.1
        crossing = geometry.polygon(rows[stop["ped_crossing_tokens"][0]]["polygon_token"])
        assert 0.5 < crossing.distance(line) < 2
        (light,) = (rows[token] for token in stop["traffic_light_tokens"])
        assert line.distance(Point(light["pose"]["tx"], light["pose"]["ty"])) < 3
        lamp, shine = np.array(geometry.line(light["line_token"]).coords)[:2]
        back = np.subtract(line.centroid.coords[0], crossing.centroid.coords[0])
        assert (shine - lamp) @ back > 0  # it faces those who arrive
        ahead = np.diff(ends_of(block, geometry), axis=0)
        assert (shine - lamp) @ ahead.mean(0) < 0


def test_lanes_lie_in_the_block_of_their_direction(tables: dict, geometry: Geometry):
    blocks = [geometry.polygon(row["polygon_token"]).buffer(0.05) for row in tables["road_block"]]
    for row in tables["lane"]:
        assert sum(block.contains(geometry.polygon(row["polygon_token"])) for block in blocks) == 1


def test_dividers_are_named_by_their_paint(city: City, tables: dict, geometry: Geometry):
    found = set()
    axes = unary_union([LineString(points) for points, _ in city.layers.road_dividers])
    for row in tables["lane"]:
        for side in ("left", "right"):
            kinds = {segment["segment_type"] for segment in row[f"{side}_lane_divider_segments"]}
            trace = geometry.points([segment["node_token"] for segment in row[f"{side}_lane_divider_segments"]])
            off_m = np.median(shapely.distance(axes, shapely.points(trace)))  # most of it, for crossings cut it
            assert (off_m < 0.05) == (kinds == {"SINGLE_SOLID_YELLOW"})
            found |= kinds
    assert {"DOUBLE_DASHED_WHITE", "NIL"} <= found  # between lanes of one direction; along the curb


def test_every_lane_leads_somewhere_and_is_reached(tables: dict):
    connectivity = tables["connectivity"]
    assert set(connectivity) == {row["token"] for row in tables["lane"] + tables["lane_connector"]}
    for token, ends in connectivity.items():
        assert ends["incoming"], token
        assert ends["outgoing"], token
        assert all(token in connectivity[other]["incoming"] for other in ends["outgoing"])
        assert all(token in connectivity[other]["outgoing"] for other in ends["incoming"])


def test_paths_join_without_gap_or_kink(tables: dict):
    paths = tables["arcline_path_3"]
    for token, ends in tables["connectivity"].items():
        onward = [(paths[token][-1], paths[after][0]) for after in ends["outgoing"]]
        for here, following in [*itertools.pairwise(paths[token]), *onward]:
            difference = np.subtract(here["end_pose"], following["start_pose"])
            assert np.abs(difference[:2]).max() < 1e-6
            assert abs(np.sin(difference[2])) < 1e-6


def test_paths_end_where_they_say(tables: dict):
    for path in tables["arcline_path_3"].values():
        for row in path:
            np.testing.assert_allclose(poses_of([row])[-1], row["end_pose"], atol=1e-3)


def test_lane_paths_follow_the_middle_of_their_lane(city: City, tables: dict):
    for row, lane in zip(tables["lane"], city.layers.lanes, strict=True):
        poses = poses_of(tables["arcline_path_3"][row["token"]])
        off_m = shapely.distance(LineString(lane.centre), shapely.points(poses[:, :2]))
        assert off_m.max() < 0.1


def test_cars_through_junctions_follow_some_connector(city: City, tables: dict):
    paths = tables["arcline_path_3"]
    lines = shapely.MultiLineString([poses_of(path)[:, :2] for path in paths.values()])
    rng = np.random.default_rng(0)
    for lane in (0, 1):
        route = city.graph.route(city.graph.random_path(rng, 0, 6), lane)
        inside = route[20:-20]  # the map's lanes begin after crossings, routes at the junction's mouth
        assert shapely.distance(lines, shapely.points(inside)).max() < 0.2


def test_the_same_city_writes_the_same_map(tmp_path: Path):
    files = [tmp_path / name / "singapore-onenorth.json" for name in ("a", "b")]
    for file in files:
        write_map_expansion(file, City(seed=1, style=BLOCK))
    assert files[0].read_bytes() == files[1].read_bytes()
    assert json.loads(files[0].read_text())["version"] == "1.3"


def test_a_city_of_bends_has_no_intersections():
    tables = map_expansion(City(seed=0, style=BLOCK), "singapore-onenorth")
    assert len(tables["road_segment"]) == 8  # four streets, four bends
    assert not any(row["is_intersection"] for row in tables["road_segment"])


@pytest.mark.parametrize("turn_rad", [-2.5, -0.8, 0.0, 0.3, 1.6])
def test_arcs_through_points_of_a_circle_keep_its_radius(turn_rad: float):
    circle = Arc(np.array([5.0, -2.0]), 0.7, 20.0, turn_rad / 20.0)
    fitted = fit_arcs(circle.at(np.linspace(0, 20, 41))[:, :2])
    assert sum(arc.length_m for arc in fitted) == pytest.approx(20.0, rel=1e-3)
    np.testing.assert_allclose([arc.curvature for arc in fitted], turn_rad / 20.0, atol=2e-3)


def test_arcs_keep_close_to_a_line_that_turns_both_ways():
    x = np.linspace(0, 40, 81)
    points = np.c_[x, 3 * np.sin(x / 6)]
    fitted = fit_arcs(points)
    poses = poses_of([row_from_arc(arc) for arc in fitted])
    assert shapely.distance(LineString(poses[:, :2]), shapely.points(points)).max() < 0.06
    assert len(fitted) < 20


def test_given_headings_are_kept_at_the_ends():
    points = np.array([[0.0, 0.0], [5.0, 0.2], [10.0, 0.0]])
    fitted = fit_arcs(points, (0.0, 0.1))
    assert fitted[0].yaw_rad == pytest.approx(0.0)
    assert fitted[-1].end[2] == pytest.approx(0.1)


def test_a_straight_line_is_one_straight():
    (arc,) = fit_arcs(np.array([[0.0, 0.0], [3.0, 4.0], [6.0, 8.0]]))
    row = row_from_arc(arc)
    assert row["segment_length"] == [0.0, pytest.approx(10.0), 0.0]
    np.testing.assert_allclose(row["end_pose"], [6.0, 8.0, np.arctan2(4, 3)])
