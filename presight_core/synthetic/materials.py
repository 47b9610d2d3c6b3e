"""What surfaces are made of, and which class each material carries."""

from enum import IntEnum

import numpy as np

from presight_core.classes import CITYSCAPES


class Material(IntEnum):
    """How a face is textured and what it is called in the label maps."""

    ASPHALT = 0
    WHITE_PAINT = 1
    YELLOW_PAINT = 2
    PAVING = 3
    CURB = 4
    GRASS = 5
    PLAZA = 6
    FACADE = 7
    ROOF = 8
    TRUNK = 9
    FOLIAGE = 10
    POLE = 11
    TRAFFIC_LIGHT = 12
    SIGN = 13
    FENCE = 14
    GARDEN_WALL = 15
    CAR_PAINT = 16
    CAR_GLASS = 17
    TYRE = 18
    CLOTH = 19
    LAMP = 20
    HEAD_LIGHT = 21
    TAIL_LIGHT = 22
    FAR_GROUND = 23


_CLASS_NAMES = {
    Material.ASPHALT: "road",
    Material.WHITE_PAINT: "road",
    Material.YELLOW_PAINT: "road",
    Material.PAVING: "sidewalk",
    Material.CURB: "sidewalk",
    Material.GRASS: "terrain",
    Material.PLAZA: "sidewalk",
    Material.FACADE: "building",
    Material.ROOF: "building",
    Material.TRUNK: "vegetation",
    Material.FOLIAGE: "vegetation",
    Material.POLE: "pole",
    Material.TRAFFIC_LIGHT: "traffic light",
    Material.SIGN: "traffic sign",
    Material.FENCE: "fence",
    Material.GARDEN_WALL: "wall",
    Material.CAR_PAINT: "car",
    Material.CAR_GLASS: "car",
    Material.TYRE: "car",
    Material.CLOTH: "person",
    Material.LAMP: "pole",
    Material.HEAD_LIGHT: "car",
    Material.TAIL_LIGHT: "car",
    Material.FAR_GROUND: "terrain",
}

LABEL_OF_MATERIAL = np.array([CITYSCAPES.index(_CLASS_NAMES[material]) for material in Material], np.uint8)
