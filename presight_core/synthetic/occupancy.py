"""Occ3D labels at one keyframe: what fills each voxel around the car, and which voxels its sensors see.

A voxel is occupied if it holds a piece of surface, as in Occ3D: the inside of a building or a car is free space that
nobody observes. Actors take their voxels from the ground they stand on; otherwise the class with most area wins.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from presight_core.cameras import Camera
from presight_core.classes import CITYSCAPES, OCC3D
from presight_core.frames import invert
from presight_core.synthetic.actors import KINDS, Actor, actor_mesh
from presight_core.synthetic.city import City
from presight_core.synthetic.jit import inner, kernel
from presight_core.synthetic.materials import Material
from presight_core.synthetic.mesh import Mesh
from presight_core.synthetic.raycast import RayCaster, Rays
from presight_core.synthetic.surface_points import Bounds, exposed, sample_surface

FREE = OCC3D.index("free")
FIRST_STATIC = OCC3D.index("driveable_surface")  # classes below are objects, from here on parts of the city
SHAPE = (200, 200, 16)  # x forward, y left, z up
LOW_M = (-40.0, -40.0, -1.0)  # ego frame
VOXEL_M = 0.4
REACH_M = 57.0  # from the car to a corner of the grid
FAR_GROUND = (0.015, 0.10)  # below the horizon at depth 1: where cameras see the ground 15 to 90 m away
FAR_GROUND_ROWS = 56  # 3.5 % apart; a curb ends 5 cm below its voxel's top, 3.7 % of a camera's height above it
SPACING_M = 0.12  # of surface points: eleven on a voxel's face
ACTOR_SPACING_M = 0.08  # a bicycle's frame is 5 cm wide

_CLASS_OF_LABEL = np.zeros(256, np.uint8)
for _label, _name in {
    "road": "driveable_surface", "sidewalk": "sidewalk", "terrain": "terrain", "vegetation": "vegetation",
    "building": "manmade", "wall": "manmade", "fence": "manmade", "pole": "manmade", "traffic light": "manmade",
    "traffic sign": "manmade",
}.items():  # fmt: skip
    _CLASS_OF_LABEL[CITYSCAPES.index(_label)] = OCC3D.index(_name)
_CLASS_OF_CATEGORY = {  # by how the nuScenes category begins
    "vehicle.car": "car", "vehicle.truck": "truck", "vehicle.trailer": "trailer", "vehicle.bus": "bus",
    "vehicle.construction": "construction_vehicle", "vehicle.motorcycle": "motorcycle", "vehicle.bicycle": "bicycle",
    "human.pedestrian": "pedestrian", "movable_object.trafficcone": "traffic_cone",
    "movable_object.barrier": "barrier",
}  # fmt: skip


class Occupancy(NamedTuple):
    """The three arrays of a `labels.npz`, SHAPE each."""

    semantics: NDArray[np.uint8]  # index into OCC3D
    mask_lidar: NDArray[np.uint8]  # 1: observed
    mask_camera: NDArray[np.uint8]


class Samples(NamedTuple):
    """Points on surfaces and what they are."""

    points: NDArray[np.float32]  # (N, 3) world
    classes: NDArray[np.uint8]  # (N,) index into OCC3D


class CitySurfaces:
    """One city, ready to be seen by any number of sensors: build it once. Calls may come from several threads."""

    def __init__(self, city: City):
        self.mesh = city.mesh
        self.caster = RayCaster(city.mesh)
        self._height_m = city.height_m
        self._size_m = city.style.size_m
        triangles, starts = city.mesh.vertices[city.mesh.faces], city.mesh.chunks[:, 0]
        self._low_m = np.minimum.reduceat(triangles.min(1), starts)  # (C, 3) the chunks' bounding boxes
        self._high_m = np.maximum.reduceat(triangles.max(1), starts)
        self._classes = static_classes(city.mesh)
        self._samples: dict[int, Samples] = {}  # of the chunks that drives came near

    def near(self, place: NDArray[np.float64]) -> list[Samples]:
        """Surface samples of every chunk that reaches within REACH_M of a place (2,), world."""
        beyond_m = np.maximum(self._low_m[:, :2] - place, place - self._high_m[:, :2])
        distance_m = np.linalg.norm(np.maximum(beyond_m, 0), axis=1)
        return [self._chunk(int(chunk)) for chunk in np.flatnonzero(distance_m < REACH_M)]

    def _chunk(self, chunk: int) -> Samples:
        if chunk not in self._samples:
            faces = np.arange(*self.mesh.chunks[chunk].tolist())
            sampled = sample_surface(self.mesh, SPACING_M, self._bounds(chunk), faces)
            sampled = sampled.select(exposed(sampled, self.caster))
            self._samples[chunk] = Samples(sampled.points, self._classes[sampled.faces])
        return self._samples[chunk]

    def _bounds(self, chunk: int) -> Bounds:
        """What of a chunk a grid can reach: the map and a margin, from -1 to 5.4 m above the road, 4 m for slopes."""
        x, y = ((self._low_m + self._high_m) / 2)[chunk, :2].tolist()
        ground_m, far_m = self._height_m(x, y), self._size_m + REACH_M
        return Bounds((-REACH_M, -REACH_M, ground_m - 5), (far_m, far_m, ground_m + 9.4))


class Moment:
    """The city with everybody on its streets at one time."""

    def __init__(self, surfaces: CitySurfaces, actors: Sequence[Actor]):
        self.surfaces = surfaces
        self.actors = actors
        self.actor_mesh = actor_mesh(actors)
        self.caster = surfaces.caster.joined_by(self.actor_mesh)

    def samples(self, place: NDArray[np.float64]) -> list[Samples]:
        """Surface samples around a place (2,), world: the city's and the actors'."""
        sampled = sample_surface(self.actor_mesh, ACTOR_SPACING_M)
        classes = actor_classes(self.actors, self.actor_mesh)
        return [*self.surfaces.near(place), Samples(sampled.points, classes[sampled.faces])]


def label_occupancy(
    moment: Moment, world_from_ego: NDArray[np.float64], camera_rays: Sequence[Rays], lidar_rays: Rays
) -> Occupancy:
    """Labels around an ego pose (4, 4), the one of the lidar's keyframe, standing on the ground as the sensors did.

    Each camera may look from where it was when it fired; the actors hold still meanwhile.
    """
    voxel_from_world = _voxel_from_ego() @ invert(world_from_ego)
    votes = np.zeros((*SHAPE, FREE), np.uint16)
    for samples in moment.samples(world_from_ego[:2, 3]):
        _count(samples.points, samples.classes, voxel_from_world, votes)
    semantics = np.empty(SHAPE, np.uint8)
    _decide(votes, semantics)
    return Occupancy(semantics, _observed(voxel_from_world, [lidar_rays]), _observed(voxel_from_world, camera_rays))


def camera_rays(caster: RayCaster, camera: Camera) -> Rays:
    """What a level camera sees, with rays so dense that none of the grid's voxels in view slips between them.

    A voxel holds a ball of its own width. Rays closer than that width over the root of two, at the grid's far
    corner, always meet it. The ground fills most of its voxels, so rows lie closer where it is seen from afar.
    """
    right, down, forward = camera.world_from_camera[:3, :3].T
    (fx, fy), (cx, cy) = np.diag(camera.intrinsics)[:2], camera.intrinsics[:2, 2]
    spacing = VOXEL_M / np.sqrt(2) / REACH_M  # at depth 1
    x = np.arange(-cx / fx, (camera.width_px - cx) / fx, spacing)
    y = np.arange(-cy / fy, (camera.height_px - cy) / fy, spacing)
    horizon = -forward[2] / down[2]
    y = np.r_[y, horizon + np.geomspace(*FAR_GROUND, FAR_GROUND_ROWS)]
    directions = forward + y[:, None, None] * down + x[:, None] * right
    directions = directions.reshape(-1, 3) / np.linalg.norm(directions, axis=-1).reshape(-1, 1)
    return caster.look(camera.world_from_camera[:3, 3], directions)


def write_occupancy(path: Path, occupancy: Occupancy) -> None:
    """Write a `labels.npz` as Occ3D has it."""
    np.savez_compressed(path, **occupancy._asdict())


def static_classes(mesh: Mesh) -> NDArray[np.uint8]:
    """The class of each face (F,) of the city; paved yards are `other_flat`, what has no class is `others`."""
    classes = _CLASS_OF_LABEL[mesh.labels]
    classes[mesh.materials == Material.PLAZA] = OCC3D.index("other_flat")
    return classes


def actor_classes(actors: Sequence[Actor], mesh: Mesh) -> NDArray[np.uint8]:
    """The class of each face (F,) of the actors' mesh, by their nuScenes categories; a rider is part of the cycle."""
    class_of = {actor.instance: _class_of_category(KINDS[actor.kind].category) for actor in actors}
    instances, which = np.unique(mesh.instances, return_inverse=True)
    return np.array([class_of[instance] for instance in instances.tolist()], np.uint8)[which]


def _class_of_category(category: str) -> int:
    found = [name for start, name in _CLASS_OF_CATEGORY.items() if category.startswith(start)]
    return OCC3D.index(found[0] if found else "others")


def _voxel_from_ego() -> NDArray[np.float64]:
    matrix = np.diag([1 / VOXEL_M] * 3 + [1.0])
    matrix[:3, 3] = -np.array(LOW_M) / VOXEL_M
    return matrix


def _observed(voxel_from_world: NDArray[np.float64], sensors: Sequence[Rays]) -> NDArray[np.uint8]:
    seen = np.zeros(SHAPE, np.uint8)
    for rays in sensors:
        reach_m = np.minimum(rays.distance_m, 2 * REACH_M).astype(np.float64)  # past the grid in any case
        _mark_seen(rays.origin, rays.directions, reach_m, voxel_from_world, seen)
    return seen


@kernel
def _count(points, classes, voxel_from_world, votes):
    """Add each point to its voxel's count of its class."""
    m = voxel_from_world
    width, depth, height = votes.shape[0], votes.shape[1], votes.shape[2]
    for n in range(len(points)):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        x = int(np.floor(m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]))
        y = int(np.floor(m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]))
        z = int(np.floor(m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]))
        if 0 <= x < width and 0 <= y < depth and 0 <= z < height:
            votes[x, y, z, classes[n]] += 1


@kernel
def _decide(votes, semantics):
    """The class with most votes; those of actors before those of the city, none at all is free."""
    width, depth, height, classes = votes.shape
    for x in range(width):
        for y in range(depth):
            for z in range(height):
                best, most = classes, 0
                for k in range(classes):
                    if k == FIRST_STATIC and most > 0:
                        break
                    if votes[x, y, z, k] > most:
                        best, most = k, votes[x, y, z, k]
                semantics[x, y, z] = best


@kernel
def _mark_seen(origin, directions, reach_m, voxel_from_world, seen):
    """Mark every voxel that a ray passes, and the one that it ends in."""
    m = voxel_from_world
    start, along = np.empty(3), np.empty(3)
    cell, following = np.empty(3, np.int64), np.empty(3)
    for axis in range(3):
        start[axis] = m[axis, 0] * origin[0] + m[axis, 1] * origin[1] + m[axis, 2] * origin[2] + m[axis, 3]
    for n in range(len(directions)):
        enter, leave = 0.0, reach_m[n]
        for axis in range(3):
            d = m[axis, 0] * directions[n, 0] + m[axis, 1] * directions[n, 1] + m[axis, 2] * directions[n, 2]
            along[axis] = d if abs(d) > 1e-9 else 1e-9  # voxels a metre; never parallel to a wall of the grid
            first, last = -start[axis] / along[axis], (seen.shape[axis] - start[axis]) / along[axis]
            enter, leave = max(enter, min(first, last)), min(leave, max(first, last))
        if enter >= leave:
            continue
        for axis in range(3):
            place = int(np.floor(start[axis] + along[axis] * enter))
            cell[axis] = min(max(place, 0), seen.shape[axis] - 1)
            following[axis] = (cell[axis] + (along[axis] > 0) - start[axis]) / along[axis]
        _walk(cell, along, following, leave, seen)


@inner
def _walk(cell, along, following, leave, seen):
    """Mark voxels from `cell` on, until `leave`; `following` is where the next wall along each axis is met."""
    width, depth, height = seen.shape
    x, y, z = cell[0], cell[1], cell[2]
    next_x, next_y, next_z = following[0], following[1], following[2]
    stride_x, stride_y, stride_z = abs(1 / along[0]), abs(1 / along[1]), abs(1 / along[2])
    step_x, step_y, step_z = 1 if along[0] > 0 else -1, 1 if along[1] > 0 else -1, 1 if along[2] > 0 else -1
    while 0 <= x < width and 0 <= y < depth and 0 <= z < height:
        seen[x, y, z] = 1
        if min(next_x, next_y, next_z) >= leave:
            return
        if next_x <= next_y and next_x <= next_z:
            next_x += stride_x
            x += step_x
        elif next_y <= next_z:
            next_y += stride_y
            y += step_y
        else:
            next_z += stride_z
            z += step_z
