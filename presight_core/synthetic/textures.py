"""Procedural textures: what a surface reflects and emits at a point, as a function of where it is.

Every function fades details out that a pixel of the given footprint (metres on the surface) cannot carry.
"""

# ruff: noqa: PLR0911, PLR0913, PLR0917 - kernels take plain numbers and leave early

import numpy as np

from presight_core.synthetic.jit import inner
from presight_core.synthetic.materials import Material
from presight_core.synthetic.noise import band, detail_strength, hash01, value_noise

# Enum members are not constants to the compiler: plain integers are.
_ASPHALT, _YELLOW_PAINT, _PAVING, _CURB = (
    int(Material.ASPHALT), int(Material.YELLOW_PAINT), int(Material.PAVING), int(Material.CURB),
)  # fmt: skip
_GRASS, _PLAZA, _FACADE, _ROOF, _TRUNK, _FOLIAGE = (
    int(Material.GRASS), int(Material.PLAZA), int(Material.FACADE), int(Material.ROOF), int(Material.TRUNK),
    int(Material.FOLIAGE),
)  # fmt: skip
_FENCE, _GARDEN_WALL, _FAR_GROUND = int(Material.FENCE), int(Material.GARDEN_WALL), int(Material.FAR_GROUND)


@inner
def is_ground(material):
    """Whether a material lies flat: its footprint stretches along the view."""
    return material <= _PLAZA or material == _FAR_GROUND


@inner
def line_strength(distance_m, half_width_m, footprint_m):
    """How dark a thin line makes a pixel: 1 on it, thinner than a pixel in proportion."""
    reach = max(half_width_m, footprint_m)
    return max(1.0 - distance_m / reach, 0.0) * min(half_width_m / reach, 1.0)


@inner
def asphalt(x, y, footprint):
    """Brightness of road surface: grain, wear, repairs, sealed cracks, manholes."""
    k = 1 + 0.30 * band(x, y, 7.0, footprint, 1) + 0.35 * band(x, y, 1.3, footprint, 2)
    k += 0.40 * band(x, y, 0.35, footprint, 3) + 0.55 * band(x, y, 0.10, footprint, 4)
    k += 0.60 * band(x, y, 0.03, footprint, 48)  # the stones
    u, v = (0.8 * x + 0.6 * y) / 7.0, (0.8 * y - 0.6 * x) / 5.0  # repairs: rectangles in cells of 7 x 5 m
    column, row = int(np.floor(u)), int(np.floor(v))
    kind = hash01(column, row, 5)
    if kind < 0.3:
        reach_u, reach_v = 0.15 + 0.3 * hash01(column, row, 6), 0.15 + 0.3 * hash01(column, row, 7)
        if abs(u - column - 0.5) < reach_u and abs(v - row - 0.5) < reach_v:
            k *= 0.70 if kind < 0.2 else 1.22
    wander = 0.5 * band(x, y, 0.8, 0.0, 8)
    ridge = abs(value_noise(x / 2.6 + wander, y / 2.6 - wander, 9) - 0.5) * 2.6  # about metres from the crack
    if value_noise(x / 11.0, y / 11.0, 10) > 0.45:
        k *= 1 - 0.62 * line_strength(ridge, 0.07, footprint)
    column, row = int(np.floor(x / 14.0)), int(np.floor(y / 14.0))  # one manhole in every other cell of 14 m
    if hash01(column, row, 11) < 0.5:
        centre_x = (column + 0.2 + 0.6 * hash01(column, row, 12)) * 14.0
        centre_y = (row + 0.2 + 0.6 * hash01(column, row, 13)) * 14.0
        radius = np.sqrt((x - centre_x) ** 2 + (y - centre_y) ** 2)
        if radius < 0.42:
            k *= 0.45 if radius < 0.34 else 1.25
    return k


@inner
def wear(x, y):
    """How much of a road marking is gone, 0..0.75."""
    spots = 0.6 * value_noise(x / 0.25, y / 0.25, 14) + 0.6 * value_noise(x / 1.7, y / 1.7, 15)
    return min(max((spots - 0.80) * 4, 0.0), 0.75)


@inner
def tiles(x, y, size, footprint):
    """Brightness of paving with joints."""
    u, v = x / size, y / size
    column, row = np.floor(u), np.floor(v)
    k = 1 + 0.25 * (hash01(int(column), int(row), 16) - 0.5) * detail_strength(3 * size, footprint)
    k += 0.3 * band(x, y, 0.5, footprint, 17) + 0.35 * band(x, y, 6.0, footprint, 18)
    gap = min(u - column, column + 1 - u, v - row, row + 1 - v) * size
    return k * (1 - 0.4 * line_strength(gap, 0.02, footprint))


@inner
def grass(x, y, footprint):
    """Brightness of grass, and how dry it is (0..1)."""
    k = 1 + 0.5 * band(x, y, 9.0, footprint, 19) + 0.5 * band(x, y, 1.6, footprint, 20)
    return k + 0.7 * band(x, y, 0.2, footprint, 21), value_noise(x / 13.0, y / 13.0, 22)


@inner
def facade(x, y, z, normal, wall, footprint, colour, lit_share):
    """Reflectance (3), gloss, emission and its warmth (0..1) of a wall with windows."""
    along = -normal[1] * x + normal[0] * y - wall[0]
    up = z - wall[2]
    pattern = int(wall[4])
    seed = pattern // 4
    k = 1 + 0.25 * band(along, up, 0.45, footprint, seed + 23) + 0.35 * band(along, up, 5.0, footprint, seed + 24)
    k *= 0.85 + 0.15 * min(max(up / 2.0, 0.0), 1.0)  # splashed foot
    if pattern & 2:  # brick courses of 0.25 x 0.5 m: larger than life, so that they survive
        course = np.floor(up / 0.25)
        brick = np.floor((along + 0.25 * (course % 2)) / 0.5)
        k *= 1 + 0.35 * (hash01(int(brick), int(course), seed) - 0.5) * detail_strength(0.6, footprint)
    if wall[3] < 2.5 or up > wall[3] or wall[1] < 2.5:  # a gable, or too narrow for windows
        return colour[0] * k, colour[1] * k, colour[2] * k, 0.0, 0.0, 0.0
    floors = max(1.0, np.floor(wall[3] / 3.3 + 0.5))
    floor_m = wall[3] / floors
    bays = max(1.0, np.floor(wall[1] / (2.2 + 1.8 * hash01(seed, 1, 25)) + 0.5))
    bay_m = wall[1] / bays
    floor, bay = np.floor(up / floor_m), np.floor(along / bay_m)
    u, v = along / bay_m - bay, up / floor_m - floor
    is_shop = floor == 0 and (pattern & 1) == 1
    half_width = 0.44 if is_shop else 0.20 + 0.20 * hash01(seed, 2, 26)
    low, high = (0.06, 0.76) if is_shop else (0.28, 0.74 + 0.1 * hash01(seed, 3, 27))
    inside_u, inside_v = half_width - abs(u - 0.5), min(v - low, high - v)
    if inside_u > 0 and inside_v > 0:
        # Offices are dark at night, homes are lit, shops advertise.
        share = 2 * lit_share if is_shop else lit_share * (0.3 + 1.4 * hash01(seed, 5, 45))
        return window(inside_u * bay_m, inside_v * floor_m, u, v, int(bay) + 13 * seed, int(floor), share)
    if inside_u > -0.06 and inside_v > -0.05 and hash01(seed, 4, 28) < 0.6:  # surround
        k *= 1.3
    elif is_shop and v > 0.82:  # sign board
        hue = hash01(int(bay) // 2, seed, 29)
        return 0.15 + 0.5 * hue, 0.12 + 0.4 * abs(hue - 0.5), 0.45 - 0.35 * hue, 0.05, 0.25 * lit_share, 0.3
    elif v < 0.05 and floor > 0:  # string course
        k *= 0.74
    return colour[0] * k, colour[1] * k, colour[2] * k, 0.0, 0.0, 0.0


@inner
def window(from_side_m, from_sill_m, u, v, bay, floor, lit_share):
    """Glass with a frame; some are lit when it gets dark, some have blinds. Values as those of `facade`."""
    if from_side_m < 0.07 or from_sill_m < 0.07 or abs(u - 0.5) < 0.012:
        return 0.55, 0.55, 0.53, 0.0, 0.0, 0.0
    fate, warmth = hash01(bay, floor, 30), hash01(bay, floor, 46)
    light = 0.0
    if hash01(bay, floor, 47) < lit_share:
        room = 0.55 + 0.45 * v - 0.5 * max(value_noise(7 * u + 9 * warmth, 4 * v, bay) - 0.45, 0.0)  # lamps hang high
        light = room * (0.2 + 0.8 * warmth * warmth)
    if fate > 0.6 and v > 0.35 + 0.4 * hash01(bay, floor, 31):  # blinds, drawn to some height
        return 0.42, 0.40, 0.36, 0.08, 0.4 * light, warmth
    t = hash01(bay, floor, 32)
    gloss = 0.15 + 0.45 * hash01(bay, floor, 49)  # panes hang at angles, and mirror other parts of the sky
    return 0.04 + 0.06 * t, 0.05 + 0.06 * t, 0.06 + 0.07 * t, gloss, light, warmth


@inner
def fence(along, up, k):
    """Brightness of a slatted fence."""
    slat = along / 0.14
    return (
        k
        * (0.45 if slat - np.floor(slat) < 0.22 else 0.9 + 0.2 * hash01(int(np.floor(slat)), 0, 33))
        * (0.8 if up - np.floor(up) < 0.1 else 1.0)
    )


@inner
def brightness(material, x, y, z, normal, footprint):
    """Texture of all materials that only vary in brightness."""
    if material == _ASPHALT:
        return asphalt(x, y, footprint)
    if material in (_PAVING, _CURB):
        return tiles(x, y, 1.2, footprint)
    if material == _PLAZA:
        return tiles(x, y, 2.4, footprint)
    if material == _ROOF:
        return 1 + 0.4 * band(x, y, 3.0, footprint, 34) + 0.3 * band(x + z, y - z, 0.5, footprint, 35)
    if material == _TRUNK:
        return 0.8 + 0.5 * value_noise((x + y) * 14, z * 2, 36)
    if material == _FENCE:
        return fence(-normal[1] * x + normal[0] * y, z, 1.0)
    if material == _GARDEN_WALL:
        along = -normal[1] * x + normal[0] * y
        return (1 + 0.5 * band(along + x * 0.1, z, 0.35, footprint, 37)) * (1 + 0.3 * band(x, y, 2.5, footprint, 38))
    if material == _FOLIAGE:
        clumps = value_noise(x * 2.2 + z, y * 2.2 - 0.7 * z, 39)
        leaves = 0.8 * band(x + 0.6 * z, y - 0.8 * z, 0.16, footprint, 40)
        leaves += 1.1 * band(x - 0.7 * z, y + 0.5 * z, 0.07, footprint, 41)
        return 0.50 + 0.7 * clumps + leaves + 0.3 * normal[2]
    return 1.0
