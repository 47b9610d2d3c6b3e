"""3D boxes of a drive's keyframes: where every actor is, and how much of it is seen."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import NDArray

from presight_core.cameras import Camera
from presight_core.synthetic.actors import KINDS, Actor, foot_of
from presight_core.synthetic.drive_plan import DrivePlan
from presight_core.synthetic.nuscenes import Box

ANNOTATED_M = 60.0  # objects farther from the car than this get no box


@dataclass
class Sightings:
    """How the sensors saw each actor (by instance) at one keyframe; sightings of several sensors add up."""

    seen_px: Counter[int] = field(default_factory=Counter)
    expected_px: Counter[int] = field(default_factory=Counter)  # if nothing hid it
    lidar_points: Counter[int] = field(default_factory=Counter)

    def add(self, other: "Sightings") -> None:
        """Count another sensor's sightings too."""
        self.seen_px.update(other.seen_px)
        self.expected_px.update(other.expected_px)
        self.lidar_points.update(other.lidar_points)

    def visible_share(self, instance: int) -> float:
        """Share of an actor's pixels that some camera sees, 0..1."""
        return min(self.seen_px[instance] / max(self.expected_px[instance], 1), 1.0)


def sightings_of_image(actors: Sequence[Actor], camera: Camera, instances: NDArray[np.int32]) -> Sightings:
    """Of the actors in front of a camera, given the instance (H, W) of each of its pixels."""
    seen = _counted(instances)
    image = shapely.box(0, 0, camera.width_px, camera.height_px)
    sightings = Sightings()
    for actor in actors:
        projected, depth_m = camera.project(corners_of(actor))
        if depth_m.min() > 0.1:  # partly behind the camera: its outline has no area there
            outline = shapely.MultiPoint(projected).convex_hull
            filled = round(0.65 * outline.intersection(image).area)  # a car fills about two thirds of its outline
            if filled > 1:
                sightings.seen_px[actor.instance] += seen[actor.instance]
                sightings.expected_px[actor.instance] += filled
    return sightings


def sightings_of_sweep(instances: NDArray[np.int32]) -> Sightings:
    """Of a lidar's points (N,), by the instance that each hit."""
    return Sightings(lidar_points=_counted(instances))


def _counted(instances: NDArray[np.int32]) -> Counter[int]:
    numbers, counts = np.unique(instances, return_counts=True)
    return Counter(dict(zip(numbers.tolist(), counts.tolist(), strict=True)))


def boxes_of(plan: DrivePlan, keyframe: int, sightings: Sightings) -> list[Box]:
    """Annotations of one keyframe: all actors within reach, seen or not, in the frame of the recorded poses."""
    time_s = plan.keyframe_s(keyframe)
    # Annotators see the world through the recorded pose: where that is too low, so are the boxes.
    lift_m = float(plan.recorded_pose(time_s)[2, 3] - plan.world_from_ego(time_s)[2, 3])
    place = plan.pose(time_s)[:2]
    return [
        _box(plan, actor, time_s, lift_m, sightings)
        for actor in plan.traffic.actors(time_s, place)
        if np.hypot(actor.x_m - place[0], actor.y_m - place[1]) < ANNOTATED_M
    ]


def corners_of(actor: Actor) -> NDArray[np.float64]:
    """The eight corners (8, 3) of an actor's box, world metres."""
    kind = KINDS[actor.kind]
    signs = np.array([[a, b, c] for a in (-0.5, 0.5) for b in (-0.5, 0.5) for c in (0.0, 1.0)])
    local = signs * [kind.length_m, kind.width_m, kind.height_m]
    c, s = np.cos(actor.yaw_rad), np.sin(actor.yaw_rad)
    return local @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + foot_of(actor)


def _box(plan: DrivePlan, actor: Actor, time_s: float, lift_m: float, sightings: Sightings) -> Box:
    kind = KINDS[actor.kind]
    x, y, foot_m = foot_of(actor).tolist()
    return Box(
        instance=actor.instance,
        category=kind.category,
        attribute=_attribute(actor),
        centre_m=(x, y, foot_m + kind.height_m / 2 + lift_m),
        size_m=(kind.width_m, kind.length_m, kind.height_m),
        yaw_rad=actor.yaw_rad,
        visible_share=sightings.visible_share(actor.instance),
        lidar_points=sightings.lidar_points[actor.instance],
    )


def _attribute(actor: Actor) -> str:
    """The one attribute that nuScenes gives an object; empty for what has none."""
    kind = KINDS[actor.kind]
    if kind.category.startswith("movable_object"):
        return ""
    if kind.category.startswith("human"):
        return "pedestrian.moving" if actor.motion == "moving" else "pedestrian.standing"
    if kind.category in ("vehicle.bicycle", "vehicle.motorcycle"):
        return "cycle.with_rider" if kind.has_rider else "cycle.without_rider"
    return f"vehicle.{actor.motion}"
