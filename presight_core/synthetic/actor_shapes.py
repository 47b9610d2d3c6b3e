"""What actors look like: solids around the origin, heading along x, and what data sets call them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from presight_core.classes import CITYSCAPES
from presight_core.synthetic.materials import Material
from presight_core.synthetic.mesh import BOX_FACES, Box, cylinder, sphere

PAINT = (-1.0, -1.0, -1.0)  # stands for the actor's own colour


@dataclass(frozen=True)
class ActorKind:
    """Outer size in metres and what nuScenes and Cityscapes call it."""

    length_m: float
    width_m: float
    height_m: float
    category: str
    label: str
    has_rider: bool = False


# Cityscapes has no classes for trailers, diggers, cones and barriers. Its annotators call the first two trucks;
# networks trained on it mostly see signs in cones and fences in barriers. Neither is masked as dynamic in mapping:
# roadworks do enter priors, as they would.
KINDS = {
    "car": ActorKind(4.5, 1.84, 1.48, "vehicle.car", "car"),
    "van": ActorKind(5.1, 1.96, 2.05, "vehicle.car", "car"),
    "truck": ActorKind(7.6, 2.45, 3.25, "vehicle.truck", "truck"),
    "bus": ActorKind(11.6, 2.55, 3.3, "vehicle.bus.rigid", "bus"),
    "trailer": ActorKind(6.0, 2.3, 2.6, "vehicle.trailer", "truck"),
    "digger": ActorKind(6.0, 1.9, 3.0, "vehicle.construction", "truck"),
    "cyclist": ActorKind(1.75, 0.6, 1.75, "vehicle.bicycle", "bicycle", has_rider=True),
    "bicycle": ActorKind(1.75, 0.55, 1.03, "vehicle.bicycle", "bicycle"),
    "motorcyclist": ActorKind(2.1, 0.75, 1.7, "vehicle.motorcycle", "motorcycle", has_rider=True),
    "motorcycle": ActorKind(2.1, 0.75, 1.15, "vehicle.motorcycle", "motorcycle"),
    "pedestrian": ActorKind(0.6, 0.6, 1.78, "human.pedestrian.adult", "person"),
    "child": ActorKind(0.41, 0.41, 1.2, "human.pedestrian.child", "person"),
    "worker": ActorKind(0.6, 0.6, 1.78, "human.pedestrian.construction_worker", "person"),
    "cone": ActorKind(0.36, 0.36, 0.75, "movable_object.trafficcone", "traffic sign"),
    "barrier": ActorKind(0.45, 2.0, 1.05, "movable_object.barrier", "fence"),  # its board lies across its heading
}


@dataclass
class _Template:
    """Parts of one kind around the origin, heading along x."""

    vertices: list[NDArray] = field(default_factory=list)
    faces: list[NDArray] = field(default_factory=list)
    materials: list[NDArray] = field(default_factory=list)
    labels: list[NDArray] = field(default_factory=list)
    colours: list[NDArray] = field(default_factory=list)
    tints: list[NDArray] = field(default_factory=list)  # share of the actor's own colour
    vertex_count: int = 0
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the solids added from here on
    scale: float = 1.0

    def add(self, solid: tuple[ArrayLike, ArrayLike], material: Material, label: str, colour: ArrayLike) -> None:
        """Append a solid; a negative colour is a share of the actor's own."""
        vertices, faces = np.asarray(solid[0], np.float64), np.asarray(solid[1], np.int64)
        count = len(faces)
        colour = np.asarray(colour, np.float64)
        self.vertices.append(vertices * self.scale + self.origin_m)
        self.faces.append(faces + self.vertex_count)
        self.vertex_count += len(vertices)
        self.materials.append(np.full(count, material, np.uint8))
        self.labels.append(np.full(count, CITYSCAPES.index(label), np.uint8))
        self.colours.append(np.tile(np.maximum(colour, 0), (count, 1)))
        self.tints.append(np.tile(np.maximum(-colour, 0), (count, 1)))


@cache
def template(kind: str) -> tuple[NDArray, ...]:
    """Vertices, faces, materials, labels, colours and tints (shares of its own colour) of an actor of a kind."""
    shape = _Template()
    _MAKERS[kind](shape, KINDS[kind])
    columns = (shape.vertices, shape.faces, shape.materials, shape.labels, shape.colours, shape.tints)
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


def _tube(a: tuple[float, float], b: tuple[float, float]) -> tuple[NDArray, NDArray]:
    """A square tube 6 cm thick between two places (x, z) in the middle plane."""
    start, end = np.array(a), np.array(b)
    across = 0.03 * np.array([start[1] - end[1], end[0] - start[0]]) / np.linalg.norm(end - start)
    return _prism([start - across, start + across, end + across, end - across], [0.03] * 4)


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


def _make_child(template: _Template, kind: ActorKind) -> None:
    template.scale = kind.height_m / KINDS["pedestrian"].height_m
    _make_pedestrian(template, kind)


def _make_bicycle(template: _Template, kind: ActorKind) -> None:
    for x in (-0.52, 0.52):
        template.add(_wheel(x, 0, 0.34, 0.05), Material.TYRE, kind.label, RUBBER)
    seat, head, pedals = (-0.2, 0.86), (0.38, 0.86), (-0.06, 0.3)
    tubes = ((pedals, seat), (pedals, head), (seat, head), ((-0.52, 0.34), seat), ((-0.52, 0.34), pedals),
             (head, (0.52, 0.34)), (head, (0.4, 1.0)))  # fmt: skip
    for tube in tubes:
        template.add(_tube(*tube), Material.CAR_PAINT, kind.label, PAINT)
    template.add(_box(-0.22, 0, 0.86, (0.26, 0.14, 0.07)), Material.TYRE, kind.label, RUBBER)  # saddle
    template.add(_box(0.42, 0, 0.98, (0.06, 0.55, 0.05)), Material.TYRE, kind.label, RUBBER)
    if kind.has_rider:
        template.origin_m = (-0.15, 0.0, 0.22)  # feet on the pedals
        _add_person(template, "rider", 0.70, 0.10, 0.28)


def _make_motorcycle(template: _Template, kind: ActorKind) -> None:
    for x in (-0.72, 0.72):
        template.add(_wheel(x, 0, 0.32, 0.13), Material.TYRE, kind.label, RUBBER)
    body = [
        (-0.95, 0.72),
        (-0.85, 0.86),
        (-0.2, 0.76),
        (0.15, 0.98),
        (0.45, 0.92),
        (0.55, 0.55),
        (0.1, 0.3),
        (-0.4, 0.3),
    ]
    template.add(_prism(body, [0.12, 0.14, 0.16, 0.17, 0.15, 0.12, 0.2, 0.2]), Material.CAR_PAINT, kind.label, PAINT)
    template.add(_box(-0.45, 0, 0.78, (0.75, 0.28, 0.1)), Material.TYRE, kind.label, RUBBER)  # seat
    fork = [(0.45, 0.95), (0.55, 0.98), (0.8, 0.34), (0.7, 0.32)]
    template.add(_prism(fork, [0.09] * 4), Material.TYRE, kind.label, (0.35, 0.35, 0.36))
    template.add(_box(0.42, 0, 1.06, (0.08, 0.74, 0.06)), Material.TYRE, kind.label, RUBBER)  # handlebar
    template.add(_box(0.58, 0, 0.86, (0.12, 0.2, 0.2)), Material.HEAD_LIGHT, kind.label, (0.75, 0.75, 0.70))
    if kind.has_rider:
        template.origin_m = (-0.25, 0.0, 0.17)  # feet on the rests
        _add_person(template, "rider", 0.70, 0.12, 0.24)


def _make_trailer(template: _Template, kind: ActorKind) -> None:
    half = kind.length_m / 2
    cargo = _box(-0.6, 0, 0.75, (kind.length_m - 1.2, kind.width_m, kind.height_m - 0.75))
    template.add(cargo, Material.CAR_PAINT, kind.label, PAINT)
    for x in (-1.5, -0.5):
        for side in (-1, 1):
            template.add(_wheel(x, side * (kind.width_m / 2 - 0.16), 0.42, 0.26), Material.TYRE, kind.label, RUBBER)
    template.add(_box(half - 0.65, 0, 0.55, (1.3, 0.12, 0.12)), Material.TYRE, kind.label, (0.2, 0.2, 0.2))  # drawbar
    template.add(_box(half - 0.8, 0, 0.0, (0.1, 0.1, 0.6)), Material.TYRE, kind.label, (0.2, 0.2, 0.2))  # its prop


def _make_digger(template: _Template, kind: ActorKind) -> None:
    """A small excavator, its arm folded in front of it."""
    iron = (0.10, 0.10, 0.10)
    for side in (-1, 1):
        template.add(_box(-1.2, side * 0.72, 0, (3.2, 0.45, 0.72)), Material.TYRE, kind.label, RUBBER)
    template.add(_box(-1.2, 0, 0.5, (1.6, 1.3, 0.45)), Material.TYRE, kind.label, iron)
    template.add(_box(-1.35, 0, 0.92, (3.2, 1.85, 0.3)), Material.CAR_PAINT, kind.label, PAINT)
    template.add(_box(-2.3, 0, 1.2, (1.3, 1.8, 0.85), 0.94), Material.CAR_PAINT, kind.label, PAINT)  # engine
    template.add(_box(-0.7, 0.42, 1.2, (1.5, 0.95, 0.55)), Material.CAR_PAINT, kind.label, PAINT)
    template.add(_box(-0.7, 0.42, 1.75, (1.45, 0.91, 0.8), 0.92), Material.CAR_GLASS, kind.label, GLASS)
    template.add(_box(-0.7, 0.42, 2.55, (1.5, 0.95, 0.1), 0.9), Material.CAR_PAINT, kind.label, PAINT)
    boom = [(-0.3, 1.1), (0.9, 2.9), (1.3, 3.0), (2.8, 2.3), (2.7, 2.05), (1.3, 2.6), (0.2, 1.1)]
    arm = [(2.5, 2.4), (2.85, 2.4), (2.75, 0.8), (2.55, 0.8)]
    for profile in (boom, arm):
        vertices, faces = _prism(profile, [0.14] * len(profile))
        template.add((vertices - [0, 0.35, 0], faces), Material.CAR_PAINT, kind.label, PAINT)
    bucket = [(2.15, 0.15), (2.3, 0.85), (2.85, 0.9), (3.0, 0.5), (2.8, 0.1)]
    vertices, faces = _prism(bucket, [0.4] * 5)
    template.add((vertices - [0, 0.35, 0], faces), Material.TYRE, kind.label, iron)


def _make_cone(template: _Template, kind: ActorKind) -> None:
    orange, white = (0.75, 0.16, 0.03), (0.75, 0.75, 0.72)
    template.add(_box(0, 0, 0, (kind.length_m, kind.width_m, 0.04)), Material.CLOTH, kind.label, RUBBER)
    rings = (0.04, 0.28, 0.46, 0.6, kind.height_m)
    for foot, top, colour in zip(rings, rings[1:], (orange, white, orange, white), strict=False):
        vertices, faces = cylinder(8)
        radius = np.where(vertices[:, 2] == 0, 0.155 - 0.165 * foot, 0.155 - 0.165 * top)[:, None]
        shaped = np.c_[vertices[:, :2] * radius, foot + vertices[:, 2] * (top - foot)]
        template.add((shaped, faces), Material.CLOTH, kind.label, colour)


def _make_barrier(template: _Template, kind: ActorKind) -> None:
    """A board striped red and white on two feet."""
    stripe_m = kind.width_m / 8
    for k in range(8):
        colour = (0.62, 0.05, 0.04) if k % 2 else (0.75, 0.75, 0.72)
        y = (k + 0.5) * stripe_m - kind.width_m / 2
        template.add(_box(0, y, 0.65, (0.05, stripe_m, 0.4)), Material.CLOTH, kind.label, colour)
    for y in (-0.7, 0.7):
        template.add(_box(0, y, 0.0, (kind.length_m, 0.12, 0.1)), Material.CLOTH, kind.label, RUBBER)
        template.add(_box(0, y, 0.1, (0.05, 0.08, 0.6)), Material.CLOTH, kind.label, (0.4, 0.4, 0.4))


_MAKERS: dict[str, Callable[[_Template, ActorKind], None]] = {
    "car": _make_car,
    "van": _make_van,
    "truck": _make_truck,
    "bus": _make_bus,
    "trailer": _make_trailer,
    "digger": _make_digger,
    "cyclist": _make_bicycle,
    "bicycle": _make_bicycle,
    "motorcyclist": _make_motorcycle,
    "motorcycle": _make_motorcycle,
    "pedestrian": _make_pedestrian,
    "child": _make_child,
    "worker": _make_pedestrian,
    "cone": _make_cone,
    "barrier": _make_barrier,
}
