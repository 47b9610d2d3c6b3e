"""Rendered views: exact depth, consistent labels, reproducible pixels."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from presight_core.cameras import Camera
from presight_core.classes import CITYSCAPES, SKY
from presight_core.frames import planar_transform
from presight_core.synthetic.actors import FIRST_ACTOR, Actor
from presight_core.synthetic.city import City
from presight_core.synthetic.compile_ahead import compile_shader
from presight_core.synthetic.graph import follow
from presight_core.synthetic.lamps import Lamps, driving, lamp_grid, street_light
from presight_core.synthetic.lighting import KINDS, sample_lighting
from presight_core.synthetic.renderer import Renderer, Views
from presight_core.synthetic.rig import RIG, rig_cameras
from presight_core.synthetic.sensor import develop
from presight_core.synthetic.shade import shade_view
from presight_core.synthetic.style import CityStyle
from presight_core.synthetic.views import View, random_view

WIDTH_PX = 96


@pytest.fixture(scope="module")
def city() -> City:
    return City(seed=1, style=CityStyle(size_m=200.0, spacing_m=90.0))


@pytest.fixture(scope="module")
def view(city: City) -> View:
    return random_view(city, np.random.default_rng(4), WIDTH_PX, "day")


@pytest.fixture(scope="module")
def views(city: City, view: View) -> Views:
    return Renderer(city).render(view.cameras, view.lighting, view.actors)


def look_down(position: np.ndarray, focal_px: float) -> Camera:
    """A camera that looks straight down."""
    world_from_camera = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
    world_from_camera[:3, 3] = position
    intrinsics = np.array([[focal_px, 0, 48], [0, focal_px, 28], [0, 0, 1]])
    return Camera(intrinsics, world_from_camera, 96, 56)


def light_at(lamps: Lamps, point: tuple[float, float, float], normal: tuple[float, float, float]) -> float:
    """Street light on one surface point."""
    return float(street_light.py_func(lamps, *point, *normal))


def nearest_hits(triangles: np.ndarray, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distances (R,) to the nearest triangle (F, 3, 3), infinite where none is hit: Moeller-Trumbore, ray by ray."""
    a = triangles[:, 0] - origin
    edge_b, edge_c = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    distances = []
    for direction in directions:
        p = np.cross(direction, edge_c)
        determinant = np.einsum("fi,fi->f", edge_b, p)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.einsum("fi,fi->f", -a, p) / determinant
            q = np.cross(-a, edge_b)
            v = q @ direction / determinant
            t = np.einsum("fi,fi->f", edge_c, q) / determinant
        inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0.15) & np.isfinite(t)
        distances.append(t[inside].min(initial=np.inf))
    return np.array(distances)


def test_depth_equals_ray_casting_through_pixel_centres(city: City, view: View):
    views = Renderer(city).render(view.cameras, view.lighting)
    triangles = city.mesh.vertices[city.mesh.faces].astype(np.float64)
    rng = np.random.default_rng(0)
    for number, camera in enumerate(view.cameras):
        columns, rows = rng.integers(0, camera.width_px, 12), rng.integers(0, camera.height_px, 12)
        pixels = np.stack([columns, rows], -1) + 0.5
        origin, directions = camera.rays(pixels)
        along_axis = directions @ camera.world_from_camera[:3, 2]
        truth = nearest_hits(triangles, origin, directions) * along_axis
        rendered = views.depth_m[number, rows, columns].astype(np.float64)
        rendered[rendered == 0] = np.inf
        np.testing.assert_allclose(rendered, truth, rtol=1e-4)


def test_sky_is_where_depth_is_zero(views: Views):
    np.testing.assert_array_equal(views.labels == SKY, views.depth_m == 0)
    assert 0.02 < (views.labels == SKY).mean() < 0.9


def test_only_actors_carry_dynamic_labels(views: Views):
    dynamic = np.isin(
        views.labels, [CITYSCAPES.index(n) for n in ("person", "rider", "car", "truck", "bus", "motorcycle", "bicycle")]
    )
    assert dynamic.any()
    assert (views.instances[dynamic] >= FIRST_ACTOR).all()


def test_same_seed_gives_the_same_bytes_in_any_number_of_threads(city: City, view: View, views: Views):
    renderer = Renderer(city)
    with ThreadPoolExecutor(4) as pool:
        runs = list(pool.map(lambda _: renderer.render(view.cameras, view.lighting, view.actors), range(4)))
    for run in runs:
        for name in ("rgb", "depth_m", "labels", "instances"):
            assert getattr(run, name).tobytes() == getattr(views, name).tobytes(), name


def test_another_seed_changes_the_noise_and_nothing_else(city: City, view: View, views: Views):
    other = Renderer(city).render(view.cameras, view.lighting, view.actors, seed=1)
    assert not np.array_equal(other.rgb, views.rgb)
    assert np.abs(other.rgb.astype(int) - views.rgb).mean() < 6  # grey levels
    np.testing.assert_array_equal(other.depth_m, views.depth_m)


@pytest.mark.parametrize("kind", KINDS)
def test_every_light_is_neither_black_nor_burnt_out(city: City, view: View, kind: str):
    lighting = sample_lighting(kind, np.random.default_rng(0))
    rgb = Renderer(city).render(view.cameras, lighting, view.actors).rgb
    low, high = (20, 90) if kind == "night" else (60, 200)
    assert low < rgb.mean() < high
    assert (rgb >= 250).mean() < 0.05


def test_asphalt_carries_texture(city: City, view: View):
    views = Renderer(city).render(view.cameras, view.lighting)
    near_road = (views.labels == CITYSCAPES.index("road")) & (views.depth_m < 12)
    grey = views.rgb.mean(-1)[near_road]
    assert grey.std() > 6  # grey levels; sensor noise alone gives 3


def test_without_antialiasing_the_truth_is_the_same(city: City, view: View, views: Views):
    plain = Renderer(city, antialias=False).render(view.cameras, view.lighting, view.actors)
    assert plain.rgb.shape == views.rgb.shape
    assert (plain.labels == views.labels).mean() > 0.999  # samples on an edge may fall to either side
    same = plain.instances == views.instances
    close = np.isclose(plain.depth_m, views.depth_m, rtol=1e-4)
    assert close[same].mean() > 0.999


def test_antialiasing_smooths_edges_and_keeps_the_brightness(city: City, view: View, views: Views):
    plain = Renderer(city, antialias=False).render(view.cameras, view.lighting, view.actors).rgb.astype(float)
    smooth = views.rgb.astype(float)
    assert np.abs(np.diff(smooth, axis=2)).mean() < 0.9 * np.abs(np.diff(plain, axis=2)).mean()
    assert abs(smooth.mean() - plain.mean()) < 3  # grey levels


def test_a_night_is_the_same_bytes_in_any_number_of_threads(city: City, view: View):
    night, ego = sample_lighting("night", np.random.default_rng(0)), view.world_from_ego
    renderer = Renderer(city)
    with ThreadPoolExecutor(3) as pool:
        runs = list(pool.map(lambda _: renderer.render(view.cameras, night, view.actors, ego=ego), range(3)))
    assert len({run.rgb.tobytes() for run in runs}) == 1


def test_a_night_is_darker_and_noisier_than_a_day(city: City, view: View):
    renderer = Renderer(city)
    grain, brightness = {}, {}
    for kind in ("day", "night"):
        lighting = sample_lighting(kind, np.random.default_rng(0))
        first, second = (renderer.render(view.cameras, lighting, seed=seed).rgb.astype(float) for seed in (0, 999))
        grain[kind], brightness[kind] = (first - second).std(), first.mean()
    assert brightness["night"] < 0.6 * brightness["day"]
    assert grain["night"] > 3 * grain["day"]


def test_the_road_is_brighter_under_a_lamp_than_between_lamps(city: City):
    camera = look_down(np.array([*city.lamps[0, :2], 45.0]), 60.0)
    night = sample_lighting("night", np.random.default_rng(0))
    views = Renderer(city).render([camera], night)
    rows, columns = np.nonzero(views.labels[0] == CITYSCAPES.index("road"))
    origin, directions = camera.rays(np.stack([columns, rows], -1) + 0.5)
    places = origin + directions * (45.0 / -directions[:, 2:])
    to_lamp_m = np.linalg.norm(places[:, None, :2] - city.lamps[:, :2], axis=2).min(1)
    grey = views.rgb[0, rows, columns].mean(-1)
    assert grey[to_lamp_m < 3].mean() > 1.5 * grey[to_lamp_m > 8].mean()


def test_head_lights_light_the_road_ahead(city: City, view: View):
    night = sample_lighting("night", np.random.default_rng(0))
    renderer = Renderer(city)
    off = renderer.render(view.cameras[:1], night)
    lit = renderer.render(view.cameras[:1], night, ego=view.world_from_ego)
    road = (off.labels == CITYSCAPES.index("road")) & (off.depth_m > 4) & (off.depth_m < 15)
    assert lit.rgb[road].mean() > 1.2 * off.rgb[road].mean()
    np.testing.assert_array_equal(off.depth_m, lit.depth_m)


def test_a_random_rig_stands_on_the_road_and_is_carried_by_its_ego(city: City, view: View):
    x, y, z = view.world_from_ego[:3, 3]
    assert abs(z - city.height_m(x, y)) < 1e-9
    np.testing.assert_allclose(
        view.cameras[0].world_from_camera, view.world_from_ego @ RIG[0].ego_from_camera, atol=1e-9
    )


def test_by_day_head_lights_change_nothing(city: City, view: View, views: Views):
    lit = Renderer(city).render(view.cameras, view.lighting, view.actors, ego=view.world_from_ego)
    np.testing.assert_array_equal(lit.rgb, views.rgb)


def test_parked_cars_have_their_lights_off():
    parked = Actor("car", 0.0, 0.0, 0.0, (0.5, 0.5, 0.5), FIRST_ACTOR)
    stopped = Actor("car", 30.0, 0.0, 0.0, (0.5, 0.5, 0.5), FIRST_ACTOR + 1, motion="stopped")
    walker = Actor("pedestrian", 30.0, 9.0, 0.0, (0.5, 0.5, 0.5), FIRST_ACTOR + 2, motion="moving")
    assert driving([parked, stopped, walker]) == [stopped]


def test_lamps_light_what_is_below_them_only():
    lamps = lamp_grid(np.array([[0.0, 0.0, 7.2], [100.0, 0.0, 7.2]]))
    up, down = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
    below = light_at(lamps, (0.0, 0.0, 0.0), up)
    assert below == pytest.approx(1, abs=0.05)
    assert below > light_at(lamps, (10.0, 0.0, 0.0), up) > 0
    assert light_at(lamps, (50.0, 0.0, 0.0), up) == 0
    assert light_at(lamps, (0.0, 0.0, 9.0), down) == 0
    assert light_at(lamps, (5000.0, 0.0, 0.0), up) == 0


def test_a_city_without_lamps_has_dark_streets():
    assert light_at(lamp_grid(np.zeros((0, 3))), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)) == 0


def test_bright_lights_glow_after_dark_only():
    lamp = np.zeros((60, 100, 3), np.float32)
    lamp[30, 50] = 50.0
    quiet = {"read_noise": 0.0, "shot_noise": 0.0, "blur": 0.0}
    rng = np.random.default_rng(0)
    day, night = (sample_lighting(kind, rng)._replace(**quiet) for kind in ("day", "night"))
    assert develop(lamp, day, 0)[30, 52].max() == 0
    assert develop(lamp, night, 0)[30, 52].min() > 0


def test_a_car_in_front_hides_the_city_and_casts_a_shadow(city: City):
    route = city.graph.route(city.graph.random_path(np.random.default_rng(0), 0, 3))
    pose, ahead = follow(route, np.array([20.0, 32.0]))
    world_from_ego = planar_transform(*pose.tolist())
    camera = rig_cameras(world_from_ego, WIDTH_PX, WIDTH_PX * 9 // 16)[0]
    lighting = sample_lighting("day", np.random.default_rng(0))
    x, y, yaw = ahead.tolist()
    car = Actor("car", x, y, yaw, (0.7, 0.1, 0.1), FIRST_ACTOR)
    renderer = Renderer(city)
    without, with_car = renderer.render([camera], lighting), renderer.render([camera], lighting, [car])
    on_car = with_car.instances == FIRST_ACTOR
    assert on_car.sum() > 50
    assert np.all(with_car.depth_m[on_car] < np.where(without.depth_m > 0, without.depth_m, np.inf)[on_car])
    beside = ~on_car & (with_car.labels == without.labels)
    darker = without.rgb.astype(int).mean(-1) - with_car.rgb.astype(int).mean(-1)
    assert (darker[beside] > 15).sum() > 5


def test_the_rig_looks_all_around():
    headings = [np.arctan2(*(m.ego_from_camera[:2, 2][::-1])) for m in RIG]
    gaps = np.diff(np.sort(np.rad2deg(headings)), append=np.rad2deg(min(headings)) + 360)
    assert gaps.max() < 75  # the rear camera alone sees 89 degrees


def test_the_shader_compiled_ahead_is_the_one_that_views_need(view: View, city: City) -> None:
    compile_shader()
    Renderer(city).render(view.cameras, view.lighting, view.actors)
    assert len(shade_view.signatures) == 1  # types that differ anywhere would have compiled it twice
