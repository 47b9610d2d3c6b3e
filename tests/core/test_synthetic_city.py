"""The procedural city: its streets, its mesh, its traffic."""

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray
from shapely import LineString, Point, Polygon, STRtree
from shapely.ops import unary_union

from presight_core.classes import CITYSCAPES
from presight_core.frames import is_rigid
from presight_core.synthetic.actors import KINDS, Actor, actor_mesh, foot_of
from presight_core.synthetic.buildings import window_seeds
from presight_core.synthetic.city import City
from presight_core.synthetic.graph import ROUTE_STEP_M, follow
from presight_core.synthetic.materials import Material
from presight_core.synthetic.mesh import Mesh
from presight_core.synthetic.street import RADIUS_M
from presight_core.synthetic.style import GARDENS, HARBOUR, TOWERS, CityStyle
from presight_core.synthetic.traffic import Traffic, plan_traffic

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
    street = graph.street(a, b)
    middle = graph.route([a, b])[len(graph.route([a, b])) // 2]
    nearest_m = street.along_m[np.argmin(np.linalg.norm(street.points - middle, axis=1))]
    left_m = float((middle - street.at(nearest_m)) @ street.left_at(nearest_m))
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
    assert all(road.contains(polygon) for polygon, _ in layers.crossings + layers.stop_lines)
    assert all(road.contains(lane.polygon) for lane in layers.lanes)


@pytest.mark.parametrize("kind", KINDS)
def test_actors_fill_the_box_that_annotations_give_them(kind: str):
    mesh = actor_mesh([Actor(kind, 0.0, 0.0, 0.0, (0.5, 0.5, 0.5), 1_000_000)])
    size = mesh.vertices.max(0) - mesh.vertices.min(0)
    box = [KINDS[kind].length_m, KINDS[kind].width_m, KINDS[kind].height_m]
    np.testing.assert_allclose(size, box, rtol=0.15)


def test_the_surface_is_the_road_or_a_curb_higher(city: City):
    on_road = city.graph.street(*city.graph.edges[0]).at(30.0)
    assert city.surface_m(*on_road) == city.height_m(*on_road)
    x, y = city.layers.walkway[0].representative_point().coords[0]
    assert city.surface_m(x, y) == pytest.approx(city.height_m(x, y) + 0.15)


def test_cyclists_carry_two_labels():
    mesh = actor_mesh([Actor("cyclist", 0.0, 0.0, 0.0, (0.5, 0.5, 0.5), 1_000_000)])
    assert {CITYSCAPES[label] for label in np.unique(mesh.labels)} == {"bicycle", "rider"}


# ---- streets -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bent() -> City:
    """Nine nodes: junctions, corners, bends, hills."""
    return City(seed=4, style=CityStyle(size_m=330.0, spacing_m=110.0, relief_m=0.5))


def test_streets_bend_but_never_tighter_than_their_least_radius(bent: City):
    turns = []
    for edge in bent.graph.edges:
        street = bent.graph.street(*edge)
        heading = np.unwrap(np.arctan2(street.tangents[:, 1], street.tangents[:, 0]))
        turns.append(np.abs(np.diff(heading) / np.diff(street.along_m)).max())
    assert max(turns) < 1 / RADIUS_M * 1.02
    assert np.median(turns) > 1 / 200


def test_streets_without_bends_are_straight():
    street = City(seed=1, style=replace(SMALL, bend_m=0.0)).graph.street(0, 1)
    assert len(street.beside((5, street.length_m - 5), 3.0)) == 2
    assert len(street.strip((5, 50), (-2, 2))) == 4


def test_a_street_seen_from_its_other_end_is_the_same_street(bent: City):
    a, b = bent.graph.edges[0]
    there, back = bent.graph.street(a, b), bent.graph.street(b, a)
    np.testing.assert_allclose(there.at(20.0, 3.0), back.at(there.length_m - 20.0, -3.0), atol=1e-9)


def test_places_beside_a_street_keep_their_distance_from_its_axis(bent: City):
    street = bent.graph.street(*bent.graph.edges[0])
    axis = LineString(street.points)
    distances = [axis.distance(Point(point)) for point in street.beside((15, street.length_m - 15), 4.0)]
    np.testing.assert_allclose(distances, 4.0, atol=0.02)


def test_streets_touch_only_at_junctions(bent: City):
    for (one, edge), (other, other_edge) in itertools.combinations(bent.layers.segments, 2):
        assert one.distance(other) > 0.5, (edge, other_edge)


def test_lanes_run_in_their_driving_direction_between_their_borders(bent: City):
    for lane in bent.layers.lanes:
        first, second = lane.centre[0], lane.centre[1]
        across = lane.left[0] - lane.right[0]
        step = second - first
        assert step[0] * across[1] - step[1] * across[0] > 0, "left border lies to the right"
        assert np.linalg.norm(across) == pytest.approx(3.4, abs=1e-6)
        assert LineString(lane.centre).within(lane.polygon.buffer(0.01))


def test_turns_join_the_lanes_that_meet_at_a_node(bent: City):
    graph = bent.graph
    lanes = {(lane.edge if lane.forward else lane.edge[::-1], lane.number): lane for lane in bent.layers.lanes}
    for node, neighbours in graph.neighbours.items():
        for a, b in itertools.permutations(neighbours, 2):
            turn = graph.turn((a, node, b))
            np.testing.assert_allclose(turn[0], lanes[(a, node), 0].centre[-1], atol=1e-6)
            np.testing.assert_allclose(turn[-1], lanes[(node, b), 0].centre[0], atol=1e-6)
            assert LineString(turn).within(bent.layers.road)


def test_no_marking_divides_a_lane_from_the_parking_bays(bent: City):
    for line, edge in bent.layers.lane_dividers:
        assert bent.graph.lanes(*edge) == 2
        axis = LineString(bent.graph.street(*edge).points)
        assert axis.distance(Point(line[0])) == pytest.approx(3.4, abs=0.02)


def test_even_a_single_block_has_crossings(city: City):
    assert not any(city.graph.is_junction(node) for node in range(len(city.graph.nodes)))
    assert city.layers.crossings
    assert len(city.layers.stop_lines) == 2 * len(city.layers.crossings)


def test_sidewalks_keep_to_the_road(bent: City):
    reach = bent.layers.road.buffer(bent.style.sidewalk_m + 0.1)
    assert all(reach.contains(polygon) for polygon in bent.layers.walkway)


def test_nothing_stands_on_the_road(bent: City):
    mesh = bent.mesh
    standing = (Material.TRUNK, Material.POLE, Material.SIGN, Material.FENCE, Material.GARDEN_WALL, Material.FACADE)
    places = mesh.vertices[np.unique(mesh.faces[np.isin(mesh.materials, standing)])]
    low = places[:, 2] < 2.2  # arms of lamps and lights hang higher
    assert not shapely.contains_xy(bent.layers.road.buffer(-0.05), *places[low, :2].T).any()


# ---- ground ------------------------------------------------------------------------------------------------------


def test_slopes_reach_a_hundredth_but_not_much_more(bent: City):
    spots = np.random.default_rng(0).uniform(0, 330, (500, 2))
    slopes = [np.linalg.norm(bent.terrain.stand(x, y, 0.0)[:2, 2]) for x, y in spots]
    assert 0.004 < max(slopes) < 0.014


def test_a_car_stands_square_on_the_slope(bent: City):
    x, y, yaw, step = 120.0, 80.0, 0.7, 0.01
    stand = bent.terrain.stand(x, y, yaw)
    ahead = np.array([x, y]) + step * np.array([np.cos(yaw), np.sin(yaw)])
    rise = (bent.height_m(*ahead) - bent.height_m(x, y)) / step
    assert is_rigid(stand)
    assert stand[2, 0] / np.linalg.norm(stand[:2, 0]) == pytest.approx(rise, abs=1e-5)
    assert np.arctan2(stand[1, 0], stand[0, 0]) == pytest.approx(yaw, abs=1e-9)


def test_paint_lies_clear_of_the_asphalt_on_any_slope(bent: City):
    """Both surfaces are triangles: at random spots of the paint, its triangle is above the asphalt's."""
    paint = _heights_under(bent.mesh, (Material.WHITE_PAINT, Material.YELLOW_PAINT))
    asphalt = _heights_under(bent.mesh, (Material.ASPHALT,))
    gaps = []
    for polygon in (bent.layers.white_paint + bent.layers.yellow_paint)[::7]:
        spot = polygon.representative_point()
        gaps.append(paint(spot) - asphalt(spot))
    assert len(gaps) > 50
    assert min(gaps) > 0.006
    assert max(gaps) < 0.018


def _heights_under(mesh: Mesh, materials: tuple[Material, ...]) -> Callable[[Point], float]:
    triangles = mesh.vertices[mesh.faces[np.isin(mesh.materials, materials)]].astype(np.float64)
    tree = STRtree([Polygon(corners[:, :2]) for corners in triangles])

    def height_m(spot: Point) -> float:
        a, b, c = triangles[tree.query(spot, "intersects")[0]]
        shares = np.linalg.solve(np.c_[b - a, c - a][:2], np.array([spot.x, spot.y]) - a[:2])
        return float(a[2] + shares @ np.array([b - a, c - a])[:, 2])

    return height_m


# ---- traffic -----------------------------------------------------------------------------------------------------

TIMES = np.linspace(0, 10, 41)


@pytest.fixture(scope="module")
def ego(bent: City) -> NDArray[np.float64]:
    route = bent.graph.route(bent.graph.straightest_path(np.random.default_rng(3), 4, 4))
    return follow(route, 5 + 6 * TIMES)


@pytest.fixture(scope="module")
def traffic(bent: City, ego: NDArray[np.float64]) -> Traffic:
    return plan_traffic(bent, np.random.default_rng(3), ego, duration_s=10.0)


def test_nobody_runs_into_the_ego_vehicle(traffic: Traffic, ego: NDArray[np.float64]):
    car = _box("car", ego + np.c_[1.4 * np.cos(ego[:, 2]), 1.4 * np.sin(ego[:, 2]), np.zeros(len(ego))])
    for track in traffic.tracks:
        gaps = shapely.distance(_box(track.kind, track.poses(TIMES)), car)
        assert gaps.min() > 0.3, track.kind


def test_nobody_runs_into_anybody(traffic: Traffic):
    """Except walkers on one sidewalk, who find a way around each other."""
    boxes = {track.instance: _box(track.kind, track.poses(TIMES)) for track in traffic.tracks}
    for one, other in itertools.combinations(traffic.tracks, 2):
        if not all(KINDS[track.kind].category.startswith("human") for track in (one, other)):
            assert not shapely.intersects(boxes[one.instance], boxes[other.instance]).any(), (one.kind, other.kind)


def test_cyclists_find_room(traffic: Traffic):
    assert sum(track.kind == "cyclist" for track in traffic.tracks) >= 6


def test_some_vehicles_stop_before_a_line_and_drive_on(traffic: Traffic):
    motions = [
        {track.motion(time) for time in TIMES.tolist()}
        for track in traffic.tracks
        if KINDS[track.kind].category == "vehicle.car" and track.is_moving
    ]
    assert {"moving", "stopped"} in motions
    assert {"moving"} in motions


def test_some_pedestrians_are_on_the_road_but_only_on_crossings(bent: City, traffic: Traffic):
    crossings = unary_union([polygon for polygon, _ in bent.layers.crossings]).buffer(1.0)
    walkers = [track for track in traffic.tracks if track.kind in ("pedestrian", "child")]
    places = [Point(place) for track in walkers for place in track.poses(TIMES)[:, :2]]
    on_road = [place for place in places if bent.layers.road.buffer(-0.5).contains(place)]
    assert on_road
    assert all(crossings.contains(place) for place in on_road)


def test_every_kind_of_actor_occurs_in_a_few_drives(bent: City):
    kinds: set[str] = set()
    for seed in range(8):
        rng = np.random.default_rng(seed)
        ego = follow(bent.graph.route(bent.graph.random_path(rng, seed, 3)), np.array([40.0]))
        kinds |= {track.kind for track in plan_traffic(bent, rng, ego, duration_s=0.0).tracks}
    assert kinds == set(KINDS)


def test_actors_stand_on_what_is_under_them(bent: City, traffic: Traffic, ego: NDArray[np.float64]):
    for actor in traffic.actors(2.0, ego[0, :2]):
        assert actor.ground_m == bent.surface_m(actor.x_m, actor.y_m)
        assert foot_of(actor)[2] == pytest.approx(actor.ground_m + 0.02)


def _box(kind: str, poses: NDArray[np.float64]) -> NDArray[np.object_]:
    """Outlines of an actor at its poses."""
    length, width = KINDS[kind].length_m / 2, KINDS[kind].width_m / 2
    corners = np.array([[length, width], [-length, width], [-length, -width], [length, -width]])
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    turned = corners @ np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], -2)
    return np.asarray(shapely.polygons(turned + poses[:, None, :2]))


# ---- styles ------------------------------------------------------------------------------------------------------


def test_named_styles_give_cities_that_differ_beyond_their_plan():
    height, green, paint = {}, {}, {}
    for name, style in {"harbour": HARBOUR, "gardens": GARDENS, "towers": TOWERS}.items():
        city = City(seed=1, style=replace(style, size_m=200.0, spacing_m=90.0))
        walls = city.mesh.vertices[city.mesh.faces[city.mesh.materials == Material.FACADE]]
        inside = (np.abs(walls[:, 0, :2] - 100) < 100).all(1)  # without the skyline
        height[name] = walls[inside, :, 2].mean()
        green[name] = (city.mesh.labels == CITYSCAPES.index("vegetation")).sum()
        paint[name] = bool(city.layers.yellow_paint)
    assert height["towers"] > 1.5 * height["harbour"]
    assert height["harbour"] > 1.5 * height["gardens"]
    assert green["gardens"] > 1.3 * max(green["harbour"], green["towers"])
    assert paint == {"harbour": True, "gardens": False, "towers": False}


@pytest.mark.parametrize("seed", range(4))
def test_random_styles_build(seed: int):
    style = CityStyle.random(np.random.default_rng(seed), size_m=200.0)
    assert len(City(seed, style).mesh.faces) > 10_000


def test_window_seeds_widen_with_the_share():
    narrow, wide = window_seeds(0.0, 0.3), window_seeds(0.7, 1.0)
    assert narrow
    assert wide
    assert not set(narrow) & set(wide)
