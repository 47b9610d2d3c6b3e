"""Buildings: flats with shops, balconies and roof units; houses with gables; a skyline far away."""

from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from presight_core.synthetic.materials import Material
from presight_core.synthetic.mesh import BOX_FACES, BOX_SIDES, BOX_TOP, Box, MeshBuilder, Surface, Wall
from presight_core.synthetic.noise import hash01
from presight_core.synthetic.style import TILES, Colour

FLOOR_M = 3.3  # storey height

BuildingKind = Literal["flats", "house", "distant"]


@dataclass(frozen=True)
class Building:
    """A building plot: foot box whose -y side faces the street, and what it looks like."""

    box: Box
    colour: tuple[float, float, float]
    pattern: int  # of its walls, see Wall
    instance: int
    kind: BuildingKind = "flats"


@cache
def window_seeds(low: float, high: float) -> tuple[int, ...]:
    """Texture seeds whose windows take such a share of their bay, from 0 (narrow) to 1 (nearly all)."""
    return tuple(seed for seed in range(1000) if low <= hash01(seed, 2, 26) <= high)  # as the facade texture draws it


def add_building(
    builder: MeshBuilder, rng: np.random.Generator, building: Building, tiles: tuple[Colour, ...] = TILES
) -> None:
    """Append one building; houses take their roofs' colour from `tiles`."""
    vertices = building.box.vertices()
    _add_walls(builder, building, vertices)
    if building.kind == "house":
        _add_gable_roof(
            builder, building, vertices, np.array(tiles[int(rng.integers(len(tiles)))]) * rng.uniform(0.7, 1.1)
        )
        return
    roof = Surface(Material.ROOF, tuple(np.full(3, rng.uniform(0.2, 0.45))), building.instance)
    builder.add(vertices, BOX_TOP, roof)
    if building.kind == "flats":
        _add_roof_units(builder, rng, building)
        if building.pattern & 1:
            _add_awnings(builder, rng, building)
        if rng.random() < 0.45:
            _add_balconies(builder, rng, building)


def _add_walls(builder: MeshBuilder, building: Building, vertices: NDArray[np.float64]) -> None:
    for side in range(4):
        a, b = vertices[side], vertices[(side + 1) % 4]
        width_m = float(np.linalg.norm(b - a))
        start_m = float((b - a)[:2] @ a[:2]) / width_m
        pattern = building.pattern if side == 0 or building.kind != "flats" else building.pattern & ~1  # shops in front
        wall = Wall(start_m, width_m, building.box.z, building.box.height, float(pattern))
        surface = Surface(Material.FACADE, building.colour, building.instance, wall=wall)
        builder.add(vertices, BOX_SIDES[2 * side : 2 * side + 2], surface)


def _add_gable_roof(
    builder: MeshBuilder, building: Building, vertices: NDArray[np.float64], tile: NDArray[np.float64]
) -> None:
    """A ridge along the street, eaves that stand out by 40 cm, gable walls below."""
    box, eaves_m = building.box, 0.4
    rise_m = 0.32 * box.width
    corners = vertices[4:]
    ridge = np.stack([corners[[0, 3]].mean(0), corners[[1, 2]].mean(0)]) + np.array([0, 0, rise_m])
    gable = Surface(Material.FACADE, building.colour, building.instance, wall=Wall(height_m=0.01))
    builder.add(np.r_[corners, ridge], [[3, 0, 4], [1, 2, 5]], gable)
    along = (corners[1] - corners[0]) / box.length * eaves_m
    down = np.array([0, 0, eaves_m * rise_m / (box.width / 2)])
    across = (corners[3] - corners[0]) / box.width * eaves_m
    low = corners + np.stack([-along - across, along - across, along + across, across - along]) - down
    high = ridge + np.stack([-along, along])
    roof = Surface(Material.ROOF, tile, building.instance)
    lift = np.array([0, 0, 0.05])  # above the gable walls
    faces = [[0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5]]
    builder.add(np.r_[low, high] + lift, faces, roof)
    builder.add(np.r_[low, high] - lift, [face[::-1] for face in faces], roof)  # seen from below


def _place(box: Box, along_m: float, out_m: float) -> NDArray[np.float64]:
    """A point (2,) in front of the street side: along it from its middle, and out from it."""
    c, s = np.cos(box.yaw_rad), np.sin(box.yaw_rad)
    across = -box.width / 2 - out_m
    return np.array([box.x + c * along_m - s * across, box.y + s * along_m + c * across])


def _add_roof_units(builder: MeshBuilder, rng: np.random.Generator, building: Building) -> None:
    box = building.box
    surface = Surface(Material.ROOF, (0.42, 0.42, 0.43), building.instance)
    for _ in range(int(rng.integers(1, 4))):
        x, y = _place(box, rng.uniform(-0.3, 0.3) * box.length, -rng.uniform(0.25, 0.75) * box.width)
        length, width = rng.uniform(2, 4, 2)
        unit = Box(x, y, box.z + box.height, length, width, rng.uniform(1, 3), box.yaw_rad)
        builder.add(unit.vertices(), BOX_FACES[2:], surface)


def _add_awnings(builder: MeshBuilder, rng: np.random.Generator, building: Building) -> None:
    """Coloured canopies over some of the shop windows."""
    box = building.box
    colours = [(0.55, 0.10, 0.08), (0.08, 0.30, 0.18), (0.10, 0.16, 0.42), (0.62, 0.50, 0.18), (0.60, 0.58, 0.55)]
    for along_m in np.arange(-box.length / 2 + 2.5, box.length / 2 - 2, 4.5):
        if rng.random() < 0.6:
            x, y = _place(box, along_m, 0.55)
            awning = Box(x, y, box.z + 2.75, 3.6, 1.1, 0.22, box.yaw_rad, 0.92)
            colour = colours[int(rng.integers(len(colours)))]
            builder.add(awning.vertices(), BOX_FACES, Surface(Material.ROOF, colour, building.instance))


def _add_balconies(builder: MeshBuilder, rng: np.random.Generator, building: Building) -> None:
    box = building.box
    surface = Surface(Material.ROOF, tuple(np.minimum(np.array(building.colour) * 1.15, 0.8)), building.instance)
    floors = max(1, round(box.height / FLOOR_M))
    step_m = rng.uniform(4.5, 7)
    for along_m in np.arange(-box.length / 2 + 2.2, box.length / 2 - 1.8, step_m):
        for floor in range(1, floors):
            x, y = _place(box, along_m, 0.5)
            foot_m = box.z + floor * box.height / floors
            builder.add(Box(x, y, foot_m, 2.8, 1.0, 0.14, box.yaw_rad).vertices(), BOX_FACES, surface)
            x, y = _place(box, along_m, 0.97)
            builder.add(Box(x, y, foot_m + 0.14, 2.8, 0.06, 0.9, box.yaw_rad).vertices(), BOX_FACES, surface)
