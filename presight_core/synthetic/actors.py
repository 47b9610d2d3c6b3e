"""Everything that moves or could: cars, vans, trucks, buses, cyclists and pedestrians."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from presight_core.classes import CITYSCAPES
from presight_core.synthetic.ground import CURB_M
from presight_core.synthetic.materials import Material
from presight_core.synthetic.mesh import BOX_FACES, Box, Mesh, cylinder, face_normals, sphere

FIRST_ACTOR = 1_000_000  # instance numbers from here on are actors, below are parts of the city
ROAD_M = 0.02  # wheels stand this far above the road, so that they never sink into its triangles
SIDEWALK_M = CURB_M + 0.01  # likewise shoes
PAINT = (-1.0, -1.0, -1.0)  # stands for the actor's own colour


@dataclass(frozen=True)
class ActorKind:
    """Outer size in metres and what nuScenes and Cityscapes call it."""

    length_m: float
    width_m: float
    height_m: float
    category: str
    label: str
    foot_m: float = ROAD_M  # above the road


KINDS = {
    "car": ActorKind(4.5, 1.84, 1.48, "vehicle.car", "car"),
    "van": ActorKind(5.1, 1.96, 2.05, "vehicle.car", "car"),
    "truck": ActorKind(7.6, 2.45, 3.25, "vehicle.truck", "truck"),
    "bus": ActorKind(11.6, 2.55, 3.3, "vehicle.bus.rigid", "bus"),
    "cyclist": ActorKind(1.75, 0.6, 1.75, "vehicle.bicycle", "bicycle"),
    "pedestrian": ActorKind(0.6, 0.6, 1.78, "human.pedestrian.adult", "person", SIDEWALK_M),
}


@dataclass(frozen=True)
class Actor:
    """One road user at one moment: vehicles stand on the road, pedestrians on the sidewalk."""

    kind: str  # a key of KINDS
    x_m: float
    y_m: float
    yaw_rad: float
    colour: tuple[float, float, float]
    instance: int  # FIRST_ACTOR or more
    ground_m: float = 0.0  # height of the road here


@dataclass
class _Template:
    """Parts of one kind around the origin, heading along x."""

    vertices: list[NDArray]
    faces: list[NDArray]
    materials: list[NDArray]
    labels: list[NDArray]
    colours: list[NDArray]
    tints: list[NDArray]  # share of the actor's own colour
    vertex_count: int = 0

    def add(self, solid: tuple[ArrayLike, ArrayLike], material: Material, label: str, colour: ArrayLike) -> None:
        """Append a solid; a negative colour is a share of the actor's own."""
        vertices, faces = np.asarray(solid[0], np.float64), np.asarray(solid[1], np.int64)
        count = len(faces)
        colour = np.asarray(colour, np.float64)
        self.vertices.append(vertices)
        self.faces.append(faces + self.vertex_count)
        self.vertex_count += len(vertices)
        self.materials.append(np.full(count, material, np.uint8))
        self.labels.append(np.full(count, CITYSCAPES.index(label), np.uint8))
        self.colours.append(np.tile(np.maximum(colour, 0), (count, 1)))
        self.tints.append(np.tile(np.maximum(-colour, 0), (count, 1)))


def actor_mesh(actors: Sequence[Actor]) -> Mesh:
    """One mesh of all actors at their places; an empty mesh for none."""
    parts = [_placed(actor) for actor in actors]
    if not parts:
        return _empty_mesh()
    starts = np.cumsum([0] + [len(part[0]) for part in parts[:-1]])
    vertices = np.concatenate([part[0] for part in parts]).astype(np.float32)
    faces = np.concatenate([part[1] + start for part, start in zip(parts, starts, strict=True)]).astype(np.int32)
    counts = np.array([len(part[1]) for part in parts])
    ends = np.cumsum(counts)
    centres = np.array([[a.x_m, a.y_m, a.ground_m + KINDS[a.kind].height_m / 2] for a in actors])
    radii = [[np.linalg.norm([KINDS[a.kind].length_m, KINDS[a.kind].width_m, 4]) / 2 + 0.3] for a in actors]
    return Mesh(
        vertices=vertices,
        faces=faces,
        normals=face_normals(vertices, faces),
        colours=np.concatenate([part[2] for part in parts]).astype(np.float32),
        walls=np.zeros((len(faces), 5), np.float32),
        materials=np.concatenate([part[3] for part in parts]),
        labels=np.concatenate([part[4] for part in parts]),
        instances=np.repeat(np.array([actor.instance for actor in actors], np.int32), counts),
        chunks=np.stack([ends - counts, ends], -1).astype(np.int64),
        spheres=np.concatenate([centres, radii], 1).astype(np.float32),
    )


def foot_of(actor: Actor) -> NDArray[np.float64]:
    """Where an actor stands (3,), world metres."""
    return np.array([actor.x_m, actor.y_m, actor.ground_m + KINDS[actor.kind].foot_m])


def _placed(actor: Actor) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray]:
    """Vertices in the world, faces, colours, materials and labels of one actor."""
    vertices, faces, materials, labels, colours, tints = _template(actor.kind)
    c, s = np.cos(actor.yaw_rad), np.sin(actor.yaw_rad)
    placed = vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + foot_of(actor)
    return placed, faces, colours + tints * np.array(actor.colour), materials, labels


def _empty_mesh() -> Mesh:
    return Mesh(
        np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32),
        np.zeros((0, 3), np.float32), np.zeros((0, 5), np.float32), np.zeros(0, np.uint8), np.zeros(0, np.uint8),
        np.zeros(0, np.int32), np.zeros((0, 2), np.int64), np.zeros((0, 4), np.float32),
    )  # fmt: skip


@cache
def _template(kind: str) -> tuple[NDArray, ...]:
    template = _Template([], [], [], [], [], [])
    _MAKERS[kind](template, KINDS[kind])
    columns = (template.vertices, template.faces, template.materials, template.labels, template.colours, template.tints)
    return tuple(np.concatenate(column) for column in columns)


# ---- solids ------------------------------------------------------------------------------------------------------


def _box(x: float, y: float, foot: float, size: tuple[float, float, float], taper: float = 1.0) -> tuple:
    """A box of (length, width, height) with its foot centre at (x, y, foot)."""
    return Box(x, y, foot, *size, 0.0, taper).vertices(), BOX_FACES


def _prism(profile: ArrayLike, half_widths: ArrayLike) -> tuple[NDArray, NDArray]:
    """A side view (N, 2) of x and z, clockwise seen from the right, spread to both sides by (N,) half widths."""
    profile, half = np.asarray(profile, np.float64), np.asarray(half_widths, np.float64)
    count = len(profile)
    right = np.c_[profile[:, 0], -half, profile[:, 1]]
    left = np.c_[profile[:, 0], half, profile[:, 1]]
    middles = np.stack([right.mean(0), left.mean(0)])
    i = np.arange(count)
    j = (i + 1) % count
    faces = np.concatenate(
        [
            np.c_[i, i + count, j], np.c_[j, i + count, j + count],
            np.c_[np.full(count, 2 * count), i, j], np.c_[np.full(count, 2 * count + 1), j + count, i + count],
        ]
    )  # fmt: skip
    return np.concatenate([right, left, middles]), faces


def _wheel(x: float, y: float, radius: float, width: float) -> tuple[NDArray, NDArray]:
    """A lying cylinder, closed on both sides."""
    sides = 10
    vertices, faces = cylinder(sides)
    vertices = np.r_[vertices, [[0, 0, 0]]]
    i = np.arange(sides)
    faces = np.r_[faces, np.c_[(i + 1) % sides, i, np.full(sides, len(vertices) - 1)]]
    turned = np.c_[vertices[:, 0] * radius, (vertices[:, 2] - 0.5) * width, vertices[:, 1] * radius]
    return turned + np.array([x, y, radius]), faces[:, ::-1]


def _ball(x: float, y: float, z: float, radius: float) -> tuple[NDArray, NDArray]:
    vertices, faces = sphere(1)
    return vertices * radius + np.array([x, y, z]), faces


GLASS = (0.03, 0.035, 0.04)
RUBBER = (0.03, 0.03, 0.03)
SKIN = (0.45, 0.29, 0.21)


def _add_running_gear(template: _Template, kind: ActorKind, axles: Sequence[float], radius: float) -> None:
    """Wheels, head lights and tail lights."""
    for x in axles:
        for side in (-1, 1):
            template.add(_wheel(x, side * (kind.width_m / 2 - 0.11), radius, 0.24), Material.TYRE, kind.label, RUBBER)
            hub = _wheel(x, side * (kind.width_m / 2 - 0.10), radius * 0.55, 0.25)
            hub = (hub[0] + np.array([0, 0, radius * 0.45]), hub[1])
            template.add(hub, Material.TYRE, kind.label, (0.30, 0.30, 0.31))
    for side in (-1, 1):
        front = _box(kind.length_m / 2 - 0.02, side * kind.width_m * 0.36, 0.58, (0.08, 0.34, 0.15))
        template.add(front, Material.HEAD_LIGHT, kind.label, (0.75, 0.75, 0.70))
        rear = _box(-kind.length_m / 2 + 0.02, side * kind.width_m * 0.37, 0.66, (0.08, 0.28, 0.16))
        template.add(rear, Material.TAIL_LIGHT, kind.label, (0.40, 0.02, 0.02))


def _make_car(template: _Template, kind: ActorKind) -> None:
    half = kind.width_m / 2
    body = [(-2.25, 0.32), (-2.27, 0.78), (-1.85, 0.93), (1.05, 0.90), (2.10, 0.74), (2.25, 0.55), (2.2, 0.30)]
    template.add(_prism(body, [half * f for f in (0.94, 0.97, 0.96, 0.98, 0.92, 0.9, 0.9)]),
                 Material.CAR_PAINT, kind.label, PAINT)  # fmt: skip
    cabin = [(-1.95, 0.90), (-1.25, 1.42), (0.15, 1.44), (1.10, 0.88)]
    template.add(_prism(cabin, [half * f for f in (0.88, 0.70, 0.70, 0.88)]), Material.CAR_GLASS, kind.label, GLASS)
    roof = [(-1.30, 1.41), (-1.20, 1.48), (0.10, 1.48), (0.20, 1.41)]
    template.add(_prism(roof, [half * 0.72] * 4), Material.CAR_PAINT, kind.label, PAINT)
    _add_running_gear(template, kind, (-1.35, 1.35), 0.32)


def _make_van(template: _Template, kind: ActorKind) -> None:
    half = kind.width_m / 2
    body = [(-2.54, 0.32), (-2.55, 1.15), (1.35, 1.12), (2.35, 0.95), (2.55, 0.6), (2.5, 0.30)]
    template.add(_prism(body, [half * f for f in (0.96, 0.99, 0.98, 0.93, 0.9, 0.9)]),
                 Material.CAR_PAINT, kind.label, PAINT)  # fmt: skip
    cabin = [(-2.53, 1.14), (-2.35, 1.82), (0.70, 1.84), (1.55, 1.08)]
    template.add(_prism(cabin, [half * f for f in (0.96, 0.86, 0.86, 0.94)]), Material.CAR_GLASS, kind.label, GLASS)
    roof = [(-2.45, 1.80), (-2.30, 2.05), (0.50, 2.05), (0.80, 1.80)]
    template.add(_prism(roof, [half * 0.88] * 4), Material.CAR_PAINT, kind.label, PAINT)
    for side in (-1, 1):  # pillars and a panelled rear half
        panel = _box(-1.55, side * half * 0.91, 1.10, (1.7, 0.06, 0.75))
        template.add(panel, Material.CAR_PAINT, kind.label, PAINT)
    _add_running_gear(template, kind, (-1.6, 1.6), 0.34)


def _make_truck(template: _Template, kind: ActorKind) -> None:
    half = kind.length_m / 2
    cargo = _box(-1.05, 0, 0.75, (kind.length_m - 2.1, kind.width_m, kind.height_m - 0.75))
    template.add(cargo, Material.CAR_PAINT, kind.label, (0.66, 0.66, 0.64))
    template.add(_box(-1.0, 0, 0.5, (kind.length_m - 2.2, 0.9, 0.3)), Material.TYRE, kind.label, (0.08, 0.08, 0.08))
    cab = [(half - 1.95, 0.45), (half - 1.95, 2.55), (half - 0.45, 2.55), (half - 0.08, 1.45), (half, 0.45)]
    template.add(_prism(cab, [kind.width_m / 2 * 0.94] * 5), Material.CAR_PAINT, kind.label, PAINT)
    screen = [(half - 0.50, 2.40), (half - 0.34, 2.40), (half - 0.02, 1.48), (half - 0.2, 1.46)]
    template.add(_prism(screen, [kind.width_m / 2 * 0.86] * 4), Material.CAR_GLASS, kind.label, GLASS)
    side_glass = _box(half - 1.0, 0, 1.5, (0.9, kind.width_m * 0.96, 0.75))
    template.add(side_glass, Material.CAR_GLASS, kind.label, GLASS)
    _add_running_gear(template, kind, (-2.6, -1.5, 2.7), 0.48)


def _make_bus(template: _Template, kind: ActorKind) -> None:
    length, width = kind.length_m, kind.width_m
    template.add(_box(0, 0, 0.35, (length, width, 0.95)), Material.CAR_PAINT, kind.label, PAINT)
    window_band = _box(0, 0, 1.3, (length * 0.996, width * 0.99, 1.25))
    template.add(window_band, Material.CAR_GLASS, kind.label, (0.05, 0.06, 0.07))
    roof = _box(0, 0, 2.55, (length, width, 0.75), 0.97)
    template.add(roof, Material.CAR_PAINT, kind.label, PAINT)
    for x in np.arange(-length / 2 + 0.1, length / 2, 1.6):  # pillars
        template.add(_box(x, 0, 1.3, (0.16, width * 1.002, 1.25)), Material.CAR_PAINT, kind.label, PAINT)
    _add_running_gear(template, kind, (-length * 0.3, length * 0.31), 0.48)


def _add_person(template: _Template, label: str, hip_m: float, stride_m: float, lean_m: float) -> None:
    """Legs, trunk, arms and head; `lean_m` moves the shoulders forward."""
    trousers = (-0.35, -0.35, -0.4)
    for side in (-1, 1):
        step = side * stride_m
        leg = [(step - 0.09, 0.0), (-0.08, hip_m), (0.09, hip_m), (step + 0.11, 0.0)]
        vertices, faces = _prism(leg, [0.07, 0.09, 0.09, 0.07])
        template.add((vertices + np.array([0, side * 0.10, 0]), faces), Material.CLOTH, label, trousers)
        arm = [(-step - 0.06, hip_m - 0.08), (lean_m - 0.05, hip_m + 0.55), (lean_m + 0.06, hip_m + 0.55),
               (-step + 0.06, hip_m - 0.08)]  # fmt: skip
        vertices, faces = _prism(arm, [0.045] * 4)
        template.add((vertices + np.array([0, side * 0.26, 0]), faces), Material.CLOTH, label, PAINT)
    trunk = [(-0.12, hip_m - 0.05), (lean_m - 0.13, hip_m + 0.58), (lean_m + 0.12, hip_m + 0.58), (0.13, hip_m - 0.05)]
    template.add(_prism(trunk, [0.17, 0.22, 0.22, 0.17]), Material.CLOTH, label, PAINT)
    template.add(_ball(lean_m + 0.02, 0, hip_m + 0.77, 0.12), Material.CLOTH, label, SKIN)
    template.add(_ball(lean_m - 0.01, 0, hip_m + 0.81, 0.115), Material.CLOTH, label, (0.06, 0.04, 0.03))


def _make_pedestrian(template: _Template, kind: ActorKind) -> None:
    _add_person(template, kind.label, 0.86, 0.18, 0.02)


def _make_cyclist(template: _Template, kind: ActorKind) -> None:
    for x in (-0.52, 0.52):
        template.add(_wheel(x, 0, 0.34, 0.05), Material.TYRE, kind.label, RUBBER)
    frame = [(-0.52, 0.30), (-0.15, 0.84), (0.40, 0.88), (0.52, 0.34), (0.40, 0.66), (-0.05, 0.34)]
    template.add(_prism(frame, [0.025] * 6), Material.CAR_PAINT, kind.label, PAINT)
    template.add(_box(0.42, 0, 0.98, (0.06, 0.55, 0.05)), Material.TYRE, kind.label, RUBBER)
    rider = _Template([], [], [], [], [], [])
    _add_person(rider, "rider", 0.70, 0.10, 0.28)
    parts = zip(rider.vertices, rider.faces, rider.materials, rider.labels, rider.colours, rider.tints, strict=True)
    start = 0
    for vertices, faces, materials, labels, colours, tints in parts:
        template.vertices.append(vertices + np.array([-0.15, 0, 0.22]))
        template.faces.append(faces - start + template.vertex_count)
        template.vertex_count += len(vertices)
        start += len(vertices)
        template.materials.append(materials)
        template.labels.append(labels)
        template.colours.append(colours)
        template.tints.append(tints)


_MAKERS = {
    "car": _make_car,
    "van": _make_van,
    "truck": _make_truck,
    "bus": _make_bus,
    "cyclist": _make_cyclist,
    "pedestrian": _make_pedestrian,
}
