"""Street furniture: lamps, signs, traffic lights, and the trees that line a street."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from presight_core.synthetic.blocks import Site
from presight_core.synthetic.graph import CROSSING_DEPTH_M, STOP_LINE_GAP_M, Crossing, Edge, StreetGraph
from presight_core.synthetic.materials import Material
from presight_core.synthetic.mesh import BOX_FACES, Box, Surface, cylinder

SIGN_OUTLINES = {  # corners (N, 2) in metres across and up, counter-clockwise as seen from the front
    "square": np.array([[-0.35, 0], [0.35, 0], [0.35, 0.7], [-0.35, 0.7]]),
    "tall": np.array([[-0.3, 0], [0.3, 0], [0.3, 0.9], [-0.3, 0.9]]),
    "wide": np.array([[-0.6, 0], [0.6, 0], [0.6, 0.55], [-0.6, 0.55]]),
    "diamond": np.array([[0, 0], [0.5, 0.5], [0, 1.0], [-0.5, 0.5]]),
    "triangle": np.array([[-0.45, 0], [0.45, 0], [0, 0.8]]),
    "round": 0.36 * np.array([[np.sin(t), 1 - np.cos(t)] for t in np.arange(12) * np.pi / 6]),
}
LAMP_STEP_M = {"arm": 28.0, "double": 34.0, "lantern": 20.0}
SIGN_COLOURS = ((0.62, 0.06, 0.06), (0.05, 0.15, 0.55), (0.80, 0.62, 0.08), (0.05, 0.33, 0.14), (0.75, 0.75, 0.75))


def furnish_streets(site: Site, graph: StreetGraph) -> None:
    """Append the furniture of every street; street trees are only noted in `site.trees`."""
    for edge in graph.edges:
        _furnish(site, graph, edge)


def _furnish(site: Site, graph: StreetGraph, edge: Edge) -> None:
    rng, (a, b) = site.rng, edge
    street, curb_m = graph.street(a, b), graph.half_width_m(a, b)
    first, last = graph.mouth_m(a) + 6, street.length_m - graph.mouth_m(b) - 6
    crossed = [crossing.middle_m for crossing in graph.crossings(a, b)]

    def free(along_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Without the places that would hide a crossing."""
        return along_m[[all(abs(place - middle) > 4.5 for middle in crossed) for place in along_m]]

    is_leafy = rng.random() < site.style.leafy_share
    for side in (-1, 1):
        for along_m in free(np.arange(first + rng.uniform(0, 8), last, 12.0)):
            if is_leafy and rng.random() < 0.85:
                site.trees.append(street.at(along_m, side * (curb_m + 1.0)))
        for along_m in free(
            np.arange(first + (5 if side > 0 else 18), last, LAMP_STEP_M[site.style.lamp])
        ):  # staggered
            _add_lamp(site, street.at(along_m, side * (curb_m + 0.5)), -side * street.left_at(along_m))
        for along_m in free(rng.uniform(first, max(last, first + 1), 3)):
            facing = -side * graph.drive_side * street.tangent_at(along_m)
            _add_sign(site, street.at(along_m, side * (curb_m + 0.7)), facing)
    for crossing in graph.crossings(a, b):
        _add_signals(site, graph, edge, crossing)


def _add_signals(site: Site, graph: StreetGraph, edge: Edge, crossing: Crossing) -> None:
    """Traffic lights at the stop lines, on the drivers' side of the street."""
    street, curb_m = graph.street(*edge), graph.half_width_m(*edge)
    for direction in crossing.stops:
        along_m = crossing.middle_m - direction * (CROSSING_DEPTH_M / 2 + STOP_LINE_GAP_M)
        inward = -graph.drive_side * direction * street.left_at(along_m)  # from the drivers' curb over their lane
        foot = street.at(along_m) - inward * (curb_m + 0.5)
        _add_traffic_light(site, foot, -direction * street.tangent_at(along_m), inward)


def _add_post(site: Site, foot: NDArray[np.float64], size_m: tuple[float, float], surface: Surface) -> float:
    """An upright post of (radius, height); returns the ground's height at its foot."""
    vertices, faces = cylinder(6)
    radius_m, height = size_m
    ground_m = float(site.terrain.height_m(*foot))
    site.builder.add(vertices * [radius_m, radius_m, height] + [*foot, ground_m], faces, surface)
    return ground_m


def _add_box(site: Site, centre: ArrayLike, foot_m: float, size: tuple, yaw_rad: float, surface: Surface) -> None:
    """A box of (length along yaw, width, height)."""
    x, y = np.asarray(centre)
    site.builder.add(Box(x, y, foot_m, size[0], size[1], size[2], yaw_rad).vertices(), BOX_FACES, surface)


def _yaw(direction: NDArray[np.float64]) -> float:
    return float(np.arctan2(direction[1], direction[0]))


def _add_lamp(site: Site, foot: NDArray[np.float64], inward: NDArray[np.float64]) -> None:
    kind = site.style.lamp
    steel = Surface(Material.POLE, site.style.lamp_colour, site.next_instance())
    if kind == "lantern":
        ground_m = _add_post(site, foot, (0.07, 4.3), steel)
        _add_lamp_head(site, foot, ground_m + 4.3, ((0.36, 0.36, 0.5), _yaw(inward)), steel.instance)
        _add_box(site, foot, ground_m + 4.8, (0.5, 0.5, 0.08), _yaw(inward), steel)
        return
    height_m = 7.5 if kind == "arm" else 9.0
    ground_m = _add_post(site, foot, (0.09, height_m), steel)
    for arm in (inward,) if kind == "arm" else (inward, -0.7 * inward):  # the shorter one is over the sidewalk
        _add_box(site, foot + arm * 1.2, ground_m + height_m - 0.1, (2.5 * np.hypot(*arm), 0.12, 0.1), _yaw(arm), steel)
        head_size = (0.8, 0.34, 0.14), _yaw(arm)
        _add_lamp_head(site, foot + arm * 2.3, ground_m + height_m - 0.24, head_size, steel.instance)


def _add_lamp_head(
    site: Site, centre: NDArray[np.float64], foot_m: float, size: tuple[tuple, float], instance: int
) -> None:
    """A glowing box of a size and yaw, noted as a lamp."""
    _add_box(site, centre, foot_m, *size, Surface(Material.LAMP, (0.75, 0.75, 0.70), instance))
    site.lamps.append(np.array([*centre, foot_m - 0.06]))


def _add_sign(site: Site, foot: NDArray[np.float64], facing: NDArray[np.float64]) -> None:
    rng, instance = site.rng, site.next_instance()
    shape = SIGN_OUTLINES[site.style.signs[int(rng.integers(len(site.style.signs)))]]
    ground_m = _add_post(site, foot, (0.045, 2.6), Surface(Material.POLE, (0.45, 0.45, 0.46), instance))
    plate = Surface(Material.SIGN, SIGN_COLOURS[int(rng.integers(len(SIGN_COLOURS)))], instance)
    across = np.array([-facing[1], facing[0]])  # to the right of who looks at it
    count = len(shape)
    flat = foot + shape[:, :1] * across
    sides = [np.c_[flat + facing * out, ground_m + 2.1 + shape[:, 1]] for out in (0.06, 0.09)]
    i = np.arange(count)
    j, fan = (i + 1) % count, np.arange(1, count - 1)
    front = np.c_[np.zeros_like(fan), fan, fan + 1] + count
    back = front[:, ::-1] - count
    rim = np.r_[np.c_[i, j, j + count], np.c_[i, j + count, i + count]]
    site.builder.add(np.concatenate(sides), np.r_[front, back, rim], plate)


def _add_traffic_light(
    site: Site, foot: NDArray[np.float64], facing: NDArray[np.float64], inward: NDArray[np.float64]
) -> None:
    """A mast with an arm over the lane; one head on the mast, one on the arm."""
    instance = site.next_instance()
    mast = Surface(Material.POLE, (0.16, 0.17, 0.16), instance)
    ground_m = _add_post(site, foot, (0.1, 5.7), mast)
    _add_box(site, foot + inward * 1.7, ground_m + 5.55, (3.4, 0.1, 0.1), _yaw(inward), mast)
    is_green = site.rng.random() < 0.5
    for place, foot_m in ((foot + inward * 3.2, ground_m + 4.75), (foot + facing * 0.2, ground_m + 2.5)):
        housing = Surface(Material.TRAFFIC_LIGHT, (0.05, 0.05, 0.05), instance)
        _add_box(site, place, foot_m, (0.3, 0.4, 1.1), _yaw(facing), housing)
        lights = ((0.10, 0.80, 0.35) if is_green else (0.02, 0.10, 0.05), (0.16, 0.12, 0.02))
        lights += ((0.14, 0.02, 0.02) if is_green else (0.95, 0.08, 0.05),)
        for number, colour in enumerate(lights):
            lens = Surface(Material.TRAFFIC_LIGHT, colour, instance)
            height = foot_m + 0.08 + 0.33 * number
            _add_box(site, place + facing * 0.15, height, (0.06, 0.27, 0.27), _yaw(facing), lens)
