"""Random street views: training data for the shipped models, and pictures for people."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from presight_core.cameras import Camera
from presight_core.synthetic.actors import Actor
from presight_core.synthetic.city import City
from presight_core.synthetic.graph import follow
from presight_core.synthetic.lighting import KINDS, Lighting, sample_lighting
from presight_core.synthetic.rig import rig_cameras
from presight_core.synthetic.traffic import plan_traffic


@dataclass(frozen=True)
class View:
    """What `Renderer.render` wants: one moment on a street."""

    cameras: tuple[Camera, ...]  # six, in the order of rig.RIG
    lighting: Lighting
    actors: tuple[Actor, ...]
    world_from_ego: NDArray[np.float64]  # (4, 4) of the car that carries the rig, for its head lights


def random_view(city: City, rng: np.random.Generator, width_px: int = 400, light: str | None = None) -> View:
    """A rig somewhere on a lane of the city, with its own light (a kind, or any) and traffic; images are 16:9."""
    graph = city.graph
    route = graph.route(graph.random_path(rng, int(rng.integers(len(graph.nodes))), 4), lane=int(rng.integers(2)))
    pose = follow(route, np.array([rng.uniform(0, len(route) / 2 - 3)]))
    x, y, yaw = pose[0].tolist()
    traffic = plan_traffic(city, rng, pose, duration_s=0.0)
    kind = light or str(rng.choice(KINDS))
    world_from_ego = city.terrain.stand(x, y, yaw)
    return View(
        cameras=rig_cameras(world_from_ego, width_px, width_px * 9 // 16),
        lighting=sample_lighting(kind, rng),
        actors=tuple(traffic.actors(0.0, pose[0, :2])),
        world_from_ego=world_from_ego,
    )
