"""How a city looks and how busy it is: what makes two cities differ in more than their street plan."""

from dataclasses import dataclass

import numpy as np

Colour = tuple[float, float, float]

# Wall colours, linear reflectance.
BRICK: tuple[Colour, ...] = ((0.40, 0.21, 0.15), (0.31, 0.17, 0.12), (0.48, 0.33, 0.23), (0.35, 0.26, 0.20))
RENDER: tuple[Colour, ...] = ((0.70, 0.64, 0.52), (0.62, 0.50, 0.36), (0.66, 0.62, 0.58), (0.52, 0.58, 0.60))
CONCRETE: tuple[Colour, ...] = ((0.48, 0.48, 0.48), (0.56, 0.55, 0.52), (0.36, 0.39, 0.44), (0.60, 0.62, 0.66))


@dataclass(frozen=True)
class CityStyle:
    """Settings of one city; lengths in metres, shares in 0..1."""

    size_m: float = 340.0  # edge of the square map
    spacing_m: float = 105.0  # between parallel streets
    margin_m: float = 55.0  # from the outermost street to the map's edge
    left_hand: bool = True
    dense_share: float = 0.55  # blocks of flats and shops; the others are houses with gardens, or parks
    park_share: float = 0.12
    leafy_share: float = 0.65  # streets lined with trees
    floors: tuple[int, int] = (3, 12)  # of dense buildings
    brick_share: float = 0.4
    walls: tuple[Colour, ...] = BRICK + RENDER + CONCRETE
    asphalt: Colour = (0.20, 0.20, 0.21)
    foliage: Colour = (0.13, 0.24, 0.07)
    bend_m: float = 9.0  # streets swing sideways by up to this; 0: a straight grid
    relief_m: float = 0.06  # height of the ground's waves; 0.5 brings slopes of a hundredth
    sidewalk_m: float = 3.2  # width
    is_axis_yellow: bool = True  # the line between the two directions; otherwise white
    is_axis_dashed: bool = False  # on streets with one lane a direction; otherwise a double line

    @staticmethod
    def random(rng: np.random.Generator, size_m: float = 340.0) -> "CityStyle":
        """Another city: its own density, greenery, colours and driving side."""
        palettes = (BRICK + RENDER, RENDER + CONCRETE, BRICK + CONCRETE, BRICK + RENDER + CONCRETE)
        low = int(rng.integers(2, 6))
        grey = float(rng.uniform(0.14, 0.26))
        return CityStyle(
            size_m=size_m,
            spacing_m=float(rng.uniform(85, 125)),
            left_hand=bool(rng.random() < 0.5),
            dense_share=float(rng.uniform(0.3, 0.75)),
            park_share=float(rng.uniform(0.05, 0.2)),
            leafy_share=float(rng.uniform(0.3, 0.9)),
            floors=(low, low + int(rng.integers(3, 12))),
            brick_share=float(rng.uniform(0.1, 0.7)),
            walls=palettes[int(rng.integers(len(palettes)))],
            asphalt=(grey, grey, grey * 1.04),
            foliage=(float(rng.uniform(0.10, 0.20)), float(rng.uniform(0.20, 0.28)), float(rng.uniform(0.05, 0.09))),
        )


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
