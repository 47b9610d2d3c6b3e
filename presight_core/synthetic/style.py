"""How a city looks and how busy it is: what makes two cities differ in more than their street plan."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

Colour = tuple[float, float, float]

# Wall colours, linear reflectance.
BRICK: tuple[Colour, ...] = ((0.40, 0.21, 0.15), (0.31, 0.17, 0.12), (0.48, 0.33, 0.23), (0.35, 0.26, 0.20))
RENDER: tuple[Colour, ...] = ((0.70, 0.64, 0.52), (0.62, 0.50, 0.36), (0.66, 0.62, 0.58), (0.52, 0.58, 0.60))
CONCRETE: tuple[Colour, ...] = ((0.48, 0.48, 0.48), (0.56, 0.55, 0.52), (0.36, 0.39, 0.44), (0.60, 0.62, 0.66))


GLASS: tuple[Colour, ...] = ((0.20, 0.26, 0.30), (0.30, 0.36, 0.38), (0.16, 0.20, 0.26), (0.42, 0.46, 0.48))
TILES: tuple[Colour, ...] = ((0.30, 0.14, 0.10), (0.16, 0.16, 0.18), (0.26, 0.19, 0.14))

LampKind = Literal["arm", "double", "lantern"]
SignShape = Literal["square", "tall", "wide", "round", "diamond", "triangle"]


@dataclass(frozen=True)
class CityStyle:
    """Settings of one city; lengths in metres, shares in 0..1, colours linear reflectance."""

    size_m: float = 340.0  # edge of the square map
    spacing_m: float = 105.0  # between parallel streets
    margin_m: float = 55.0  # from the outermost street to the map's edge
    bend_m: float = 9.0  # streets swing sideways by up to this; 0: a straight grid
    relief_m: float = 0.06  # height of the ground's waves; 0.5 brings slopes of a hundredth
    left_hand: bool = True

    sidewalk_m: float = 3.2  # width; at least 2.6, for somebody walks there
    asphalt: Colour = (0.20, 0.20, 0.21)
    paving: Colour = (0.42, 0.40, 0.38)
    is_axis_yellow: bool = True  # the line between the two directions; otherwise white
    is_axis_dashed: bool = False  # on streets with one lane a direction; otherwise a double line
    lamp: LampKind = "arm"
    lamp_colour: Colour = (0.30, 0.31, 0.32)
    signs: tuple[SignShape, ...] = ("square", "tall", "wide", "round")

    dense_share: float = 0.55  # blocks of flats and shops; the others are houses with gardens, or parks
    park_share: float = 0.12
    floors: tuple[int, int] = (3, 12)  # of dense buildings
    tower_share: float = 0.08  # of dense buildings: glass on a base of two floors
    tower_floors: tuple[int, int] = (14, 24)
    set_back_m: float = 1.0  # from the sidewalk to dense buildings; 0.7 clears the inside of any bend
    brick_share: float = 0.4
    walls: tuple[Colour, ...] = BRICK + RENDER + CONCRETE
    tiles: tuple[Colour, ...] = TILES  # roofs of houses
    windows: tuple[float, float] = (0.0, 1.0)  # how wide, from narrow to nearly the whole bay

    leafy_share: float = 0.65  # streets lined with trees
    hedge_share: float = 0.2  # of garden borders; the others are fences and walls
    tree_radius_m: tuple[float, float] = (1.4, 2.5)
    tree_stretch: tuple[float, float] = (0.9, 1.4)  # height of a crown by its width
    foliage: Colour = (0.13, 0.24, 0.07)

    @staticmethod
    def random(rng: np.random.Generator, size_m: float = 340.0) -> "CityStyle":
        """Another city: its own plan, buildings, greenery, colours, furniture and driving side."""
        palettes = (BRICK + RENDER, RENDER + CONCRETE, BRICK + CONCRETE, BRICK + RENDER + CONCRETE)
        low, grey, leaf = int(rng.integers(2, 6)), float(rng.uniform(0.14, 0.26)), float(rng.uniform(1.2, 2.2))
        lamps: tuple[LampKind, ...] = ("arm", "double", "lantern")
        shapes: tuple[SignShape, ...] = ("square", "tall", "wide", "round", "diamond", "triangle")
        window = float(rng.uniform(0, 0.6))
        stretch = float(rng.uniform(0.7, 1.5))
        steel = float(rng.uniform(0.05, 0.4))
        paving = rng.uniform(0.3, 0.5) * np.array([1.0, rng.uniform(0.88, 1.0), rng.uniform(0.8, 1.0)])
        return CityStyle(
            size_m=size_m,
            spacing_m=float(rng.uniform(85, 125)),
            bend_m=float(rng.uniform(0, 10)),
            relief_m=float(rng.uniform(0.03, 0.5)),
            left_hand=bool(rng.random() < 0.5),
            sidewalk_m=float(rng.uniform(2.6, 4.6)),
            asphalt=(grey, grey, grey * 1.04),
            paving=(float(paving[0]), float(paving[1]), float(paving[2])),
            is_axis_yellow=bool(rng.random() < 0.5),
            is_axis_dashed=bool(rng.random() < 0.5),
            lamp=lamps[int(rng.integers(3))],
            lamp_colour=(steel, steel, steel),
            signs=tuple(shapes[k] for k in rng.choice(len(shapes), 3, replace=False)),
            dense_share=float(rng.uniform(0.3, 0.75)),
            park_share=float(rng.uniform(0.05, 0.2)),
            floors=(low, low + int(rng.integers(3, 12))),
            tower_share=float(rng.choice([0.0, rng.uniform(0.05, 0.4)])),
            set_back_m=float(rng.uniform(0.8, 4.0)),
            brick_share=float(rng.uniform(0.1, 0.7)),
            walls=palettes[int(rng.integers(len(palettes)))],
            windows=(window, window + 0.4),
            leafy_share=float(rng.uniform(0.3, 0.9)),
            hedge_share=float(rng.uniform(0, 0.7)),
            tree_radius_m=(leaf, leaf * 1.6),
            tree_stretch=(stretch, stretch * 1.5),
            foliage=(float(rng.uniform(0.10, 0.20)), float(rng.uniform(0.20, 0.28)), float(rng.uniform(0.05, 0.09))),
        )


HARBOUR = CityStyle(
    spacing_m=125.0,
    margin_m=60.0,
    relief_m=0.15,
    left_hand=False,
    sidewalk_m=4.2,
    paving=(0.40, 0.34, 0.29),
    asphalt=(0.17, 0.17, 0.18),
    lamp="lantern",
    lamp_colour=(0.05, 0.06, 0.06),
    signs=("square", "tall", "diamond"),
    dense_share=0.85,
    park_share=0.08,
    floors=(3, 7),
    tower_share=0.06,
    set_back_m=0.8,
    brick_share=0.9,
    walls=BRICK + RENDER[:1],
    windows=(0.0, 0.35),
    leafy_share=0.5,
    hedge_share=0.1,
)
"""An old port: right-hand traffic, brick, wide streets, lanterns."""

GARDENS = CityStyle(
    spacing_m=100.0,
    relief_m=0.5,
    sidewalk_m=2.8,
    paving=(0.44, 0.44, 0.42),
    is_axis_yellow=False,
    is_axis_dashed=True,
    lamp="arm",
    lamp_colour=(0.42, 0.43, 0.44),
    signs=("round", "triangle", "wide"),
    dense_share=0.12,
    park_share=0.2,
    floors=(3, 5),
    tower_share=0.0,
    set_back_m=4.0,
    brick_share=0.15,
    walls=RENDER,
    tiles=((0.36, 0.15, 0.09), (0.42, 0.20, 0.12)),
    leafy_share=1.0,
    hedge_share=0.75,
    tree_radius_m=(2.0, 3.4),
    tree_stretch=(0.7, 1.0),
    foliage=(0.09, 0.24, 0.06),
)
"""A suburb: left-hand traffic, houses behind hedges, wide trees, hills, white lines."""

TOWERS = CityStyle(
    spacing_m=110.0,
    bend_m=6.0,
    relief_m=0.3,
    sidewalk_m=4.6,
    paving=(0.36, 0.37, 0.39),
    asphalt=(0.24, 0.24, 0.25),
    is_axis_yellow=False,
    lamp="double",
    lamp_colour=(0.55, 0.56, 0.58),
    signs=("round", "wide", "square"),
    dense_share=0.9,
    park_share=0.1,
    floors=(6, 14),
    tower_share=0.55,
    tower_floors=(14, 30),
    set_back_m=3.5,
    brick_share=0.0,
    walls=CONCRETE,
    windows=(0.55, 1.0),
    leafy_share=0.7,
    hedge_share=0.4,
    tree_radius_m=(1.0, 1.6),
    tree_stretch=(1.6, 2.4),
    foliage=(0.12, 0.20, 0.09),
)
"""A business district: left-hand traffic, concrete and glass towers, slender trees."""


@dataclass(frozen=True)
class Density:
    """How busy the streets are; counts are upper bounds, for who finds no room stays at home."""

    vehicles: int = 26  # driving
    cyclists: int = 9
    motorcyclists: int = 3
    pedestrians: int = 34  # on sidewalks
    crossing: int = 7  # pedestrians on crossings
    parked: float = 0.42  # share of bays taken
    bicycles: int = 7  # left on sidewalks
    roadworks: int = 2
    stopping: float = 0.45  # share of those on wheels that stop at a stop line once
