"""The procedural city: its streets, its mesh, its traffic."""

import numpy as np
import pytest
from shapely import Point
from shapely.ops import unary_union

from presight_core.classes import CITYSCAPES
from presight_core.synthetic.actors import KINDS, Actor, actor_mesh, foot_of
from presight_core.synthetic.city import City
from presight_core.synthetic.graph import ROUTE_STEP_M, follow
from presight_core.synthetic.style import CityStyle
from presight_core.synthetic.traffic import plan_traffic

SMALL = CityStyle(size_m=200.0, spacing_m=90.0)


@pytest.fixture(scope="module")
def city() -> City:
    return City(seed=1, style=SMALL)


def test_same_seed_builds_the_same_mesh_bit_by_bit(city: City):
    again = City(seed=1, style=SMALL)
    for name, values in city.mesh._asdict().items():
        assert values.tobytes() == getattr(again.mesh, name).tobytes(), name


def test_another_seed_builds_another_city(city: City):
    other = City(seed=2, style=SMALL)
    assert not np.array_equal(city.graph.nodes, other.graph.nodes)


def test_the_mesh_shows_every_static_class_a_street_has(city: City):
    names = {CITYSCAPES[label] for label in np.unique(city.mesh.labels)}
    assert {"road", "sidewalk", "building", "vegetation", "terrain", "pole", "traffic sign"} <= names


def test_normals_have_unit_length(city: City):
    lengths = np.linalg.norm(city.mesh.normals, axis=1)
    np.testing.assert_allclose(lengths[lengths > 0], 1, atol=1e-5)


def test_every_face_lies_inside_the_sphere_of_its_chunk(city: City):
    mesh = city.mesh
    for (first, end), sphere in zip(mesh.chunks, mesh.spheres, strict=True):
        corners = mesh.vertices[mesh.faces[first:end]].reshape(-1, 3)
        assert np.linalg.norm(corners - sphere[:3], axis=1).max() <= sphere[3] * 1.001


def test_the_ground_undulates_by_centimetres_only(city: City):
    heights = [city.height_m(x, y) for x in range(0, 1000, 37) for y in range(0, 1000, 41)]
    assert 0.04 < max(heights) - min(heights) < 0.13


@pytest.mark.parametrize("left_hand", [True, False])
def test_traffic_keeps_to_its_side_of_the_road(left_hand: bool):
    graph = City(seed=1, style=CityStyle(size_m=200.0, spacing_m=90.0, left_hand=left_hand)).graph
    a, b = graph.edges[0]
    line = graph.line(a, b)
    middle = graph.route([a, b])[len(graph.route([a, b])) // 2]
    left_m = float((middle - line.origin) @ line.left)
    assert (left_m > 0) == left_hand


def test_routes_stay_on_the_road(city: City):
    rng = np.random.default_rng(0)
    road = unary_union(city.layers.drivable)
    for start in range(len(city.graph.nodes)):
        route = city.graph.route(city.graph.random_path(rng, start, 4))
        assert all(road.contains(Point(point)) for point in route[::5])


def test_followed_routes_advance_by_the_distance_asked_for(city: City):
    route = city.graph.route(city.graph.random_path(np.random.default_rng(0), 0, 3))
    poses = follow(route, np.array([10.0, 10.0 + ROUTE_STEP_M]))
    assert np.linalg.norm(poses[1, :2] - poses[0, :2]) == pytest.approx(ROUTE_STEP_M, rel=0.05)


def test_lanes_crossings_and_stop_lines_lie_on_the_road():
    layers = City(seed=1, style=CityStyle(size_m=260.0, spacing_m=75.0)).layers  # nine nodes: junctions at last
    road = layers.road.buffer(0.01)
    assert layers.crossings
    assert len(layers.crossings) == len(layers.stop_lines)
    assert all(road.contains(polygon) for polygon, _ in layers.crossings + layers.stop_lines)
    assert all(road.contains(lane.polygon) for lane in layers.lanes)


def test_nobody_drives_into_the_ego_vehicle(city: City):
    rng = np.random.default_rng(3)
    route = city.graph.route(city.graph.random_path(rng, 0, 4))
    times = np.linspace(0, 6, 61)
    ego = follow(route, 5 + 6 * times)
    traffic = plan_traffic(city, rng, ego, duration_s=6.0)
    driving = [track for track in traffic.tracks if track.is_moving and track.kind != "pedestrian"]
    assert driving
    for track in driving:
        gaps = np.linalg.norm(track.poses(times)[:, :2] - ego[:, :2], axis=1)
        assert gaps.min() > 1.9, track.kind  # half a car and half a lane


@pytest.mark.parametrize("kind", KINDS)
def test_actors_fill_the_box_that_annotations_give_them(kind: str):
    mesh = actor_mesh([Actor(kind, 0.0, 0.0, 0.0, (0.5, 0.5, 0.5), 1_000_000)])
    size = mesh.vertices.max(0) - mesh.vertices.min(0)
    box = [KINDS[kind].length_m, KINDS[kind].width_m, KINDS[kind].height_m]
    np.testing.assert_allclose(size, box, rtol=0.15)


def test_vehicles_stand_on_the_road_and_pedestrians_on_the_sidewalk(city: City):
    ground_m = city.height_m(50, 60)
    feet_m = [foot_of(Actor(kind, 50, 60, 0, (0.5, 0.5, 0.5), 1_000_000))[2] for kind in ("car", "pedestrian")]
    np.testing.assert_allclose(np.array(feet_m) - ground_m, [0.02, 0.16])


def test_cyclists_carry_two_labels():
    mesh = actor_mesh([Actor("cyclist", 0.0, 0.0, 0.0, (0.5, 0.5, 0.5), 1_000_000)])
    assert {CITYSCAPES[label] for label in np.unique(mesh.labels)} == {"bicycle", "rider"}
