"""Taking a drive: renders and writes its images, lidar sweeps and ground truth."""

import io
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from presight_core.cameras import Camera
from presight_core.synthetic import nuscenes
from presight_core.synthetic.annotations import Sightings, sightings_of_image, sightings_of_sweep
from presight_core.synthetic.drive_plan import DrivePlan, Shot, Turn
from presight_core.synthetic.files import write_whole
from presight_core.synthetic.lidar import ego_from_lidar, sweep, write_sweep
from presight_core.synthetic.occupancy import CitySurfaces, Moment, camera_rays, label_occupancy, write_occupancy
from presight_core.synthetic.presets import SynthPreset
from presight_core.synthetic.renderer import Renderer, Views
from presight_core.synthetic.rig import RIG, rig_camera
from presight_core.synthetic.shadow import Shadows


@dataclass(frozen=True)
class Shooting:
    """One drive while it is taken; methods may run side by side in threads."""

    plan: DrivePlan
    preset: SynthPreset
    root: Path
    renderer: Renderer
    shadows: Shadows
    surfaces: CitySurfaces

    def take(self, event: Shot | Turn) -> Sightings:
        """Write what a sensor sees; returns what of the actors a keyframe shows."""
        return self._shoot(event) if isinstance(event, Shot) else self._turn(event)

    def _shoot(self, shot: Shot) -> Sightings:
        """One image, and the ground truth of a keyframe; what an interrupted run left is taken as it is."""
        plan = self.plan
        world_from_ego = plan.world_from_ego(shot.time_s)
        camera = self._camera(shot)
        actors = plan.traffic.actors(shot.time_s, world_from_ego[:2, 3])
        image, truth = (self.root / path for path in (nuscenes.image_path(plan, shot), nuscenes.truth_path(plan, shot)))
        if not image.exists():
            seed = (plan.noise_seed + 7919 * shot.moment + 101 * shot.mount.delay_us) % 2**31  # another grain each time
            views = self.renderer.render([camera], plan.lighting, actors, self.shadows, seed, world_from_ego)
            if shot.is_keyframe:
                write_whole(truth, _truth(views))
            write_whole(image, self._jpeg(views))
        if not shot.is_keyframe:
            return Sightings()
        with np.load(truth) as arrays:
            return sightings_of_image(actors, camera, arrays["instances"])

    def _turn(self, turn: Turn) -> Sightings:
        """Send out the lidar once; write its points, and at a keyframe the occupancy around the car, if asked for."""
        plan = self.plan
        world_from_ego = plan.world_from_ego(turn.time_s)
        moment = Moment(self.surfaces, plan.traffic.actors(turn.time_s, world_from_ego[:2, 3]))
        rng = np.random.default_rng([plan.noise_seed, turn.number])
        returned = sweep(moment.caster, world_from_ego @ ego_from_lidar(), rng)
        if self.preset.lidar:
            write_sweep(self.root / nuscenes.sweep_path(plan, turn), returned.points)
        if not turn.is_keyframe:
            return Sightings()
        if self.preset.occupancy:
            path = self.root / nuscenes.occupancy_path(plan, turn.keyframe)
            path.parent.mkdir(parents=True, exist_ok=True)
            rays = [camera_rays(moment.caster, camera) for camera in self._cameras(turn.keyframe)]
            write_occupancy(path, label_occupancy(moment, world_from_ego, rays, returned.rays))
        return sightings_of_sweep(returned.instances)

    def _cameras(self, keyframe: int) -> list[Camera]:
        """The six cameras of a keyframe, each where the car is when it fires."""
        shots = self.plan.shots(sweeps=False)[keyframe * len(RIG) : (keyframe + 1) * len(RIG)]
        return [self._camera(shot) for shot in shots]

    def _camera(self, shot: Shot) -> Camera:
        world_from_ego = self.plan.world_from_ego(shot.time_s)
        return rig_camera(shot.mount, world_from_ego, self.preset.width_px, self.preset.height_px)

    def _jpeg(self, views: Views) -> bytes:
        bgr = np.ascontiguousarray(views.rgb[0][..., ::-1])
        return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, self.preset.jpeg_quality])[1].tobytes()


def _truth(views: Views) -> bytes:
    """Depth in half precision: 0.05 % of the depth, a tenth of what any method here resolves."""
    content = io.BytesIO()
    depth_m = views.depth_m[0].astype(np.float16)
    np.savez_compressed(content, depth=depth_m, labels=views.labels[0], instances=views.instances[0])
    return content.getvalue()
