"""Pictures of a city with exact depth, labels and instances. CPU only, no randomness but the seeds given."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from presight_core.cameras import Camera
from presight_core.classes import SKY
from presight_core.frames import invert
from presight_core.synthetic.actors import Actor, actor_mesh
from presight_core.synthetic.city import City
from presight_core.synthetic.lamps import driving, head_light_beams, lamp_grid
from presight_core.synthetic.lighting import Lighting
from presight_core.synthetic.mesh import Mesh
from presight_core.synthetic.raster import PinholeView, draw_perspective
from presight_core.synthetic.sensor import develop
from presight_core.synthetic.shade import Scene, shade_view
from presight_core.synthetic.shadow import ZENITH, Shadows, cast_shadows, shadow_map

NEAR_M = 0.15
FAR_M = 1500.0
ACTOR_SHADOW_M = 60.0  # radius around the cameras within which actors throw shadows


@dataclass(frozen=True)
class Views:
    """K images of one size; ground truth is sampled at pixel centres, where `Camera.rays` looks."""

    rgb: NDArray[np.uint8]  # (K, H, W, 3)
    depth_m: NDArray[np.float32]  # (K, H, W) along the optical axis; 0 where the sky is
    labels: NDArray[np.uint8]  # (K, H, W) Cityscapes train ids
    instances: NDArray[np.int32]  # (K, H, W) 0: none; FIRST_ACTOR or more: actors


class Renderer:
    """Renders one city. Calls are independent of each other and release the interpreter: use threads freely.

    city = City(seed=3)
    view = random_view(city, np.random.default_rng(0), width_px=400)  # street pose, rig, light, traffic
    views = Renderer(city).render(view.cameras, view.lighting, view.actors)

    Antialiasing weighs nine samples a pixel, and costs about half the speed; ground truth is the same without it.
    `shade`: `shade_view`, or what stands for it until it is compiled.
    """

    def __init__(self, city: City, antialias: bool = True, shade: Callable[..., None] = shade_view):
        self.city = city
        self.antialias = antialias
        self._shade = shade
        self._lamps = lamp_grid(city.lamps)

    def cast_shadows(self, lighting: Lighting, centre: ArrayLike, radius_m: float = 130.0) -> Shadows:
        """Shadows of the city around a place (2,) or (3,), to be shared by many renders under the same light."""
        x, y = np.asarray(centre, np.float64)[:2]
        return cast_shadows(self.city.mesh, lighting, (x, y, 0.0), radius_m)

    def render(
        self,
        cameras: Sequence[Camera],
        lighting: Lighting,
        actors: Sequence[Actor] = (),
        shadows: Shadows | None = None,
        seed: int = 0,
        ego: NDArray[np.float64] | None = None,
    ) -> Views:
        """Images of all cameras, which must share one size.

        `seed` decides the sensor noise; `ego` is world_from_ego (4, 4) of the car whose head lights shine after dark.
        """
        centre = np.mean([camera.world_from_camera[:3, 3] for camera in cameras], axis=0)
        vehicles = driving(actors) if lighting.lamps > 0 else []
        moving = _switch_on(actor_mesh(actors), vehicles)
        scene = Scene(
            self.city.mesh,
            moving,
            lighting,
            shadows or self.cast_shadows(lighting, centre),
            shadow_map(moving, lighting.to_sun, centre, ACTOR_SHADOW_M, 0.12),
            shadow_map(moving, ZENITH, centre, ACTOR_SHADOW_M, 0.25),
            self._lamps,
            head_light_beams(vehicles, ego if lighting.lamps > 0 else None, centre),
        )
        shots = [self._shoot(scene, camera, seed + 1000 * k) for k, camera in enumerate(cameras)]
        rgb, depth_m, labels, instances = (np.stack(column) for column in zip(*shots, strict=True))
        return Views(rgb, depth_m, labels, instances)

    def _shoot(self, scene: Scene, camera: Camera, seed: int) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        height, width = camera.height_px, camera.width_px
        shape = (2 * height + 1, 2 * width + 1) if self.antialias else (height, width)
        nearness, faces = np.zeros(shape, np.float32), np.full(shape, -1, np.int32)
        view = pinhole_view(camera, self.antialias)
        draw_perspective(scene.city, view, 0, nearness, faces)
        if len(scene.actors.faces):
            draw_perspective(scene.actors, view, len(scene.city.faces), nearness, faces)
        exposure = np.empty((height, width, 3), np.float32)
        self._shade(scene, view, self.antialias, nearness, faces, exposure)
        rgb = develop(exposure, scene.lighting, seed)
        centres = np.s_[1::2, 1::2] if self.antialias else np.s_[:, :]
        return rgb, *ground_truth(scene.city, scene.actors, nearness[centres], faces[centres])


def pinhole_view(camera: Camera, antialias: bool = True) -> PinholeView:
    """The camera in sample coordinates.

    With antialiasing sample k lies at image coordinate k / 2, pixel centres at odd k; without, at k + 0.5.
    """
    k = np.asarray(camera.intrinsics, np.float64)
    scale, shift = (2.0, 0.0) if antialias else (1.0, 0.5)
    return PinholeView(
        focal_x=float(scale * k[0, 0]),
        focal_y=float(scale * k[1, 1]),
        centre_x=float(scale * k[0, 2] - shift),
        centre_y=float(scale * k[1, 2] - shift),
        camera_from_world=np.ascontiguousarray(invert(camera.world_from_camera)[:3, :3]),
        position=np.ascontiguousarray(camera.world_from_camera[:3, 3], np.float64),
        near_m=NEAR_M,
        far_m=FAR_M,
    )


def _switch_on(mesh: Mesh, vehicles: Sequence[Actor]) -> Mesh:
    """The actors' mesh with the lights of these vehicles on: actors have no walls, so the first entry says so."""
    walls = np.zeros_like(mesh.walls)
    walls[:, 0] = np.isin(mesh.instances, [vehicle.instance for vehicle in vehicles])
    return mesh._replace(walls=walls)


def ground_truth(
    city: Mesh, actors: Mesh, nearness: NDArray[np.float32], faces: NDArray[np.int32]
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.int32]]:
    """Depth, labels and instances of visibility buffers."""
    labels = np.concatenate([city.labels, actors.labels, [np.uint8(SKY)]])
    instances = np.concatenate([city.instances, actors.instances, [np.int32(0)]])
    seen = faces >= 0
    depth_m = np.where(seen, 1 / np.where(seen, nearness, 1), 0).astype(np.float32)
    return depth_m, labels[faces], instances[faces]  # -1, the sky, takes the last entry
