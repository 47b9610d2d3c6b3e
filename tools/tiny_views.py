"""Labelled street views of many small procedural cities: what the tiny networks learn from and are measured on."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from presight_core.cameras import Camera
from presight_core.synthetic.actors import FIRST_ACTOR, Actor
from presight_core.synthetic.city import City
from presight_core.synthetic.renderer import Renderer, Views
from presight_core.synthetic.style import CityStyle
from presight_core.synthetic.views import View, random_view

WIDTH_PX, HEIGHT_PX = 400, 225  # nuScenes' 16:9 at a quarter of its size
CITY_M = 340.0  # about three blocks across: a minute's drive, built in under a second
RIGS_PER_CITY = 8  # a new city costs as much as half a rig of six images
FIRST_UNSEEN_SEED = 1_000_000  # cities from here on are for measuring only
RARE_SHARE = 0.08  # of the cars; more, and cars are taken for buses
EXTRA_INSTANCE = 500_000  # instance numbers of added actors follow the traffic's own

Change = Callable[[City, View, np.random.Generator], View]


@dataclass(frozen=True)
class LabelledImages:
    """Images (N, 225, 400, 3) and their Cityscapes train ids (N, 225, 400)."""

    rgb: NDArray[np.uint8]
    labels: NDArray[np.uint8]


def training_views(rig_count: int, seed: int, threads: int) -> Iterator[LabelledImages]:
    """One rig of six images at a time, from cameras of many kinds, with people and large vehicles close by."""
    return _rendered(rig_count, seed, threads, _for_training)


def unseen_views(rig_count: int, threads: int) -> Iterator[LabelledImages]:
    """One rig of six images at a time, plain nuScenes cameras in ordinary traffic, of cities never trained on."""
    return _rendered(rig_count, FIRST_UNSEEN_SEED, threads, _unchanged)


def _rendered(rig_count: int, seed: int, threads: int, change: Change) -> Iterator[LabelledImages]:
    city_count = -(-rig_count // RIGS_PER_CITY)
    counts = [rig_count // city_count + (k < rig_count % city_count) for k in range(city_count)]
    with ThreadPoolExecutor(threads) as pool:
        for k, count in enumerate(counts):
            rng = np.random.default_rng([seed, k])
            city = City(seed + k, CityStyle.random(rng, CITY_M))
            renderer = Renderer(city)
            views = [change(city, random_view(city, rng, WIDTH_PX), rng) for _ in range(count)]
            noise_seeds = rng.integers(2**31, size=count).tolist()
            for shot in pool.map(partial(_shoot, renderer), views, noise_seeds):
                yield LabelledImages(shot.rgb, shot.labels)


def _shoot(renderer: Renderer, view: View, noise_seed: int) -> Views:
    return renderer.render(view.cameras, view.lighting, view.actors, seed=noise_seed)


def _unchanged(city: City, view: View, rng: np.random.Generator) -> View:
    return view


def _for_training(city: City, view: View, rng: np.random.Generator) -> View:
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
    """The traffic with a few cars made trucks, buses or cyclists, and people close by.

    Ordinary traffic shows too few of these for a training of minutes.
    """
    rare = ("truck", "bus", "cyclist")
    actors = [
        replace(actor, kind=str(rng.choice(rare)))
        if actor.kind in ("car", "van") and rng.random() < RARE_SHARE
        else actor
        for actor in view.actors
    ]
    x, y = view.cameras[0].world_from_camera[:2, 3]
    for k in range(int(rng.integers(4, 16))):
        distance, bearing = 25 * np.sqrt(rng.uniform(0.03, 1)), rng.uniform(0, 2 * np.pi)  # 4 to 25 m
        x_m, y_m = float(x + distance * np.cos(bearing)), float(y + distance * np.sin(bearing))
        actors.append(
            Actor(
                kind=str(rng.choice(["pedestrian", "cyclist"], p=[0.8, 0.2])),
                x_m=x_m,
                y_m=y_m,
                ground_m=float(city.surface_m(x_m, y_m)),
                yaw_rad=float(rng.uniform(0, 2 * np.pi)),
                colour=tuple(rng.uniform(0.03, 0.7, 3).tolist()),
                instance=FIRST_ACTOR + EXTRA_INSTANCE + k,
            )
        )
    return tuple(actors)
