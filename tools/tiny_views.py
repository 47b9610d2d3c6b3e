"""Labelled street views of many small procedural cities: what the tiny networks learn from and are measured on."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from presight_core.cameras import Camera
from presight_core.synthetic.actors import FIRST_ACTOR, Actor
from presight_core.synthetic.city import City
from presight_core.synthetic.lighting import KINDS, sample_lighting
from presight_core.synthetic.renderer import Renderer, Views
from presight_core.synthetic.rig import rig_cameras
from presight_core.synthetic.style import CityStyle
from presight_core.synthetic.views import View, random_view

WIDTH_PX, HEIGHT_PX = 400, 225  # nuScenes' 16:9 at a quarter of its size
CITY_M = 340.0  # about three blocks across: a minute's drive, built in about a second
RIGS_PER_CITY = {"training": 6, "unseen": 4}  # a city costs as much as three rigs of six images, a new look is worth it
FIRST_UNSEEN_SEED = 1_000_000  # cities from here on are for measuring only
LARGE = {"truck": 0.4, "bus": 0.4, "trailer": 0.1, "digger": 0.1}  # what some cars become, and how often
LARGE_SHARE = 0.08  # of the cars; more, and cars are taken for buses
BESIDE = {"bus": 0.6, "truck": 0.25, "trailer": 0.15}  # what some rigs have right beside them
BESIDE_SHARE = 0.3  # of the rigs: a bus that fills a picture is its only bus, and ordinary traffic hardly shows it
BESIDE_M = 3.2, 5.0  # across, from the middle of the car
NEAR = {
    "pedestrian": 0.45, "child": 0.1, "worker": 0.05, "cyclist": 0.15, "motorcyclist": 0.1, "bicycle": 0.1,
    "motorcycle": 0.05,
}  # fmt: skip
NEAR_M = 4.0, 25.0  # from the camera; beyond, they are few pixels
EXTRA_INSTANCE = 500_000  # instance numbers of added actors follow the traffic's own

Place = Callable[[City, Sequence[str], np.random.Generator], list[View]]


@dataclass(frozen=True)
class LabelledImages:
    """Images (N, 225, 400, 3), their Cityscapes train ids (N, 225, 400), and their light (N,), an index of KINDS."""

    rgb: NDArray[np.uint8]
    labels: NDArray[np.uint8]
    lights: NDArray[np.uint8]


def training_views(rig_count: int, seed: int, threads: int) -> Iterator[LabelledImages]:
    """One rig of six images at a time, from cameras of many kinds, with people and large vehicles close by."""
    return _rendered(rig_count, RIGS_PER_CITY["training"], seed, threads, _for_training)


def unseen_views(rig_count: int, threads: int) -> Iterator[LabelledImages]:
    """One rig of six images at a time, plain nuScenes cameras in ordinary traffic, of cities never trained on."""
    return _rendered(rig_count, RIGS_PER_CITY["unseen"], FIRST_UNSEEN_SEED, threads, _ordinary)


def _rendered(rig_count: int, rigs_per_city: int, seed: int, threads: int, place: Place) -> Iterator[LabelledImages]:
    """Every light takes its turn, so that each has its quarter of the rigs."""
    lights = [k % len(KINDS) for k in range(rig_count)]
    with ThreadPoolExecutor(threads) as pool:
        for k, first in enumerate(range(0, rig_count, rigs_per_city)):
            rng = np.random.default_rng([seed, k])
            city = City(seed + k, CityStyle.random(rng, CITY_M))
            here = lights[first : first + rigs_per_city]
            views = place(city, [KINDS[light] for light in here], rng)
            noise_seeds = rng.integers(2**31, size=len(views)).tolist()
            shots = pool.map(partial(_shoot, Renderer(city)), views, noise_seeds)
            for shot, light in zip(shots, here, strict=True):
                yield LabelledImages(shot.rgb, shot.labels, np.full(len(shot.rgb), light, np.uint8))


def _shoot(renderer: Renderer, view: View, noise_seed: int) -> Views:
    return renderer.render(view.cameras, view.lighting, view.actors, seed=noise_seed, ego=view.world_from_ego)


def _ordinary(city: City, lights: Sequence[str], rng: np.random.Generator) -> list[View]:
    return [random_view(city, rng, WIDTH_PX, light) for light in lights]


def _for_training(city: City, lights: Sequence[str], rng: np.random.Generator) -> list[View]:
    """Two places in each traffic, because to plan it costs as much as to render it."""
    views: list[View] = []
    for k, light in enumerate(lights):
        views.append(_elsewhere(city, views[-1], light, rng) if k % 2 else random_view(city, rng, WIDTH_PX, light))
    return [_for_learning(city, view, rng) for view in views]


def _elsewhere(city: City, view: View, light: str, rng: np.random.Generator) -> View:
    """The rig some way up or down the street and turned, under another light; where it stood if there is no room."""
    places = np.array([[actor.x_m, actor.y_m] for actor in view.actors]).reshape(-1, 2)
    ego = view.world_from_ego
    for _ in range(20):
        x, y = (ego @ [rng.choice([-1, 1]) * rng.uniform(8, 30), rng.normal(0, 1.5), 0, 1])[:2]
        clear_m = 5.0  # half a large vehicle: no camera stands inside one
        is_free = (np.hypot(*(places - (x, y)).T) > clear_m).all()
        if is_free and shapely.contains_xy(city.layers.road, x, y):
            yaw = np.arctan2(ego[1, 0], ego[0, 0]) + rng.normal(0, 0.5)
            ego = city.terrain.stand(x, y, yaw)
            break
    cameras = rig_cameras(ego, WIDTH_PX, HEIGHT_PX)
    return View(cameras, sample_lighting(light, rng), view.actors, ego)


def _for_learning(city: City, view: View, rng: np.random.Generator) -> View:
    cameras = tuple(_other_camera(camera, rng) for camera in view.cameras)
    return replace(view, cameras=cameras, actors=_busier(city, view, rng))


def _other_camera(camera: Camera, rng: np.random.Generator) -> Camera:
    """A camera of other focal length, attitude and height, as other cars carry."""
    zoom = np.diag([*[rng.uniform(0.7, 1.25)] * 2, 1.0])
    pitch, yaw, roll = rng.normal(0, [0.05, 0.25, 0.03])  # radians; yaw may be anything, the horizon may not
    about_x = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    about_y = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    about_z = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    world_from_camera = camera.world_from_camera.copy()
    world_from_camera[:3, :3] = world_from_camera[:3, :3] @ about_y @ about_x @ about_z
    world_from_camera[2, 3] += rng.uniform(-0.3, 0.6)
    intrinsics = camera.intrinsics.copy()
    intrinsics[:2, :2] = zoom[:2, :2] @ intrinsics[:2, :2]
    return replace(camera, intrinsics=intrinsics, world_from_camera=world_from_camera)


def _busier(city: City, view: View, rng: np.random.Generator) -> tuple[Actor, ...]:
    """The traffic with a few cars made large vehicles, and people on foot and on two wheels close by.

    Ordinary traffic shows too few of these for a training of minutes.
    """
    actors = [
        replace(actor, kind=_one_of(LARGE, rng))
        if actor.kind in ("car", "van") and rng.random() < LARGE_SHARE
        else actor
        for actor in view.actors
    ]
    if rng.random() < BESIDE_SHARE:
        actors.append(_vehicle_beside(city, view, rng))
    x_m, y_m = _places_nearby(city, view.world_from_ego[:2, 3], rng)
    grounds_m = city.surface_m(x_m, y_m)
    for k in range(len(x_m)):
        actors.append(
            Actor(
                kind=_one_of(NEAR, rng),
                x_m=float(x_m[k]),
                y_m=float(y_m[k]),
                ground_m=float(grounds_m[k]),
                yaw_rad=float(rng.uniform(0, 2 * np.pi)),
                colour=tuple(rng.uniform(0.03, 0.7, 3).tolist()),
                instance=FIRST_ACTOR + EXTRA_INSTANCE + k,
            )
        )
    return tuple(actors)


def _vehicle_beside(city: City, view: View, rng: np.random.Generator) -> Actor:
    """A large vehicle in the next lane or at the kerb, along the way or against it."""
    ego, side, nearest_m, farthest_m = view.world_from_ego, rng.choice([-1, 1]), *BESIDE_M
    x_m, y_m = (ego @ [rng.uniform(-12, 12), side * rng.uniform(nearest_m, farthest_m), 0, 1])[:2]
    return Actor(
        kind=_one_of(BESIDE, rng),
        x_m=float(x_m),
        y_m=float(y_m),
        ground_m=float(city.surface_m([x_m], [y_m])[0]),
        yaw_rad=float(np.arctan2(ego[1, 0], ego[0, 0]) + rng.normal(0, 0.1) + np.pi * rng.integers(2)),
        colour=tuple(rng.uniform(0.03, 0.7, 3).tolist()),
        instance=FIRST_ACTOR + EXTRA_INSTANCE - 1,
    )


def _places_nearby(
    city: City, centre: ArrayLike, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """East and north coordinates of up to sixteen places on the street or its sidewalks, not in gardens or houses."""
    nearest_m, farthest_m = NEAR_M
    distance = farthest_m * np.sqrt(rng.uniform((nearest_m / farthest_m) ** 2, 1, 32))
    bearing = rng.uniform(0, 2 * np.pi, 32)
    x_m, y_m = np.asarray(centre)[:, None] + distance * np.stack([np.cos(bearing), np.sin(bearing)])
    on_street = shapely.distance(city.layers.road, shapely.points(x_m, y_m)) < city.style.sidewalk_m
    chosen = np.flatnonzero(on_street)[: int(rng.integers(4, 17))]
    return x_m[chosen], y_m[chosen]


def _one_of(shares: dict[str, float], rng: np.random.Generator) -> str:
    return str(rng.choice(list(shares), p=list(shares.values())))
