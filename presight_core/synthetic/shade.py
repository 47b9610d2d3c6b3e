"""Deferred shading: the light on every pixel, from the faces that its samples see.

With antialiasing a pixel is the tent-filtered sum of 3 x 3 samples half a pixel apart, its own centre in the middle;
each face is shaded once a pixel, at its first sample, so that edges are smooth and textures stay cheap. Without, a
pixel is the one sample at its centre.
"""

# ruff: noqa: PLR0913, PLR0917 - kernels take plain numbers and leave early

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from presight_core.synthetic.jit import inner, shader, spliced
from presight_core.synthetic.lamps import Lamps, beam_light, street_light
from presight_core.synthetic.lighting import Lighting
from presight_core.synthetic.materials import Material
from presight_core.synthetic.mesh import Mesh
from presight_core.synthetic.noise import band, value_noise
from presight_core.synthetic.raster import PinholeView
from presight_core.synthetic.shadow import ShadowMap, Shadows, occlusion
from presight_core.synthetic.textures import brightness, facade, grass, is_ground, wear

# Plain integers for the compiler.
_WHITE_PAINT, _YELLOW_PAINT = int(Material.WHITE_PAINT), int(Material.YELLOW_PAINT)
_GRASS, _FAR_GROUND, _FACADE = int(Material.GRASS), int(Material.FAR_GROUND), int(Material.FACADE)
_FOLIAGE, _ROOF, _CURB = int(Material.FOLIAGE), int(Material.ROOF), int(Material.CURB)
_CAR_PAINT, _CAR_GLASS, _LAMP = int(Material.CAR_PAINT), int(Material.CAR_GLASS), int(Material.LAMP)
_HEAD_LIGHT, _TAIL_LIGHT = int(Material.HEAD_LIGHT), int(Material.TAIL_LIGHT)
_TRAFFIC_LIGHT = int(Material.TRAFFIC_LIGHT)

LAMP_LIGHT = 0.75  # straight below a street lamp
BEAM_LIGHT = 1.00  # of head lights on a wall at 7 m


class Scene(NamedTuple):
    """All that the shader reads."""

    city: Mesh
    actors: Mesh  # its faces are numbered after the city's
    lighting: Lighting
    shadows: Shadows  # of the city
    actor_sun: ShadowMap
    actor_sky: ShadowMap
    lamps: Lamps
    beams: NDArray[np.float64]  # (B, 5) head lights, see `head_light_beams`


@inner
def sky_colour(dx, dy, dz, light):
    """Sky radiance (red, green, blue) in a unit direction."""
    up = max(dz, 0.0)
    low = np.exp(-5.0 * up)  # the bright band over the horizon ends at about 20 degrees
    towards = max(dx * light.to_sun[0] + dy * light.to_sun[1] + dz * light.to_sun[2], 0.0)
    glow = light.glow * (0.35 * towards**8 + 6 * towards**900)  # aureole and disc
    cloud = 0.0
    if dz > 0.02:
        u, v = 1.6 * dx / (dz + 0.12), 1.6 * dy / (dz + 0.12)
        puffs = 0.55 * value_noise(u, v, 11) + 0.28 * value_noise(2.3 * u, 2.3 * v, 12)
        puffs += 0.17 * value_noise(5 * u, 5 * v, 13)
        cloud = light.clouds * min(max((puffs - 0.42) * 3.2, 0.0), 1.0) * min(dz * 6, 1.0)
    red = light.zenith[0] + (light.horizon[0] - light.zenith[0]) * low
    green = light.zenith[1] + (light.horizon[1] - light.zenith[1]) * low
    blue = light.zenith[2] + (light.horizon[2] - light.zenith[2]) * low
    white = 0.55 * light.ambient[1] + 0.20 * light.sun[1]
    red += (white - red) * cloud + glow * light.sun[0] / 2
    green += (white - green) * cloud + glow * light.sun[1] / 2
    blue += (white - blue) * cloud + glow * light.sun[2] / 2
    return red, green, blue


@spliced
def face_surface(mesh, face):
    """Material, normal, colour and wall of a face, as numbers: views of arrays would be counted, pixel by pixel."""
    n, c, w = mesh.normals, mesh.colours, mesh.walls
    return (
        int(mesh.materials[face]),
        (float(n[face, 0]), float(n[face, 1]), float(n[face, 2])),
        (float(c[face, 0]), float(c[face, 1]), float(c[face, 2])),
        (float(w[face, 0]), float(w[face, 1]), float(w[face, 2]), float(w[face, 3]), float(w[face, 4])),
    )


@spliced
def shade_point(scene, face, ray, depth, focal, position):
    """Radiance towards the camera of a face seen along `ray` (unit depth, world axes) at an optical-axis depth."""
    light = scene.lighting
    city_faces = len(scene.city.materials)
    if face < city_faces:
        material, normal, colour, wall = face_surface(scene.city, face)
    else:
        material, normal, colour, wall = face_surface(scene.actors, face - city_faces)
    stretch = np.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2)
    dx, dy, dz = ray[0] / stretch, ray[1] / stretch, ray[2] / stretch
    x, y, z = position[0] + ray[0] * depth, position[1] + ray[1] * depth, position[2] + ray[2] * depth
    distance = depth * stretch
    nx, ny, nz = normal
    facing = nx * dx + ny * dy + nz * dz
    if facing > 0:  # the back of a leaf
        nx, ny, nz, facing = -nx, -ny, -nz, -facing
    footprint = distance / focal / max(-facing, 0.08)
    if is_ground(material):
        footprint = 0.5 * distance / focal / max(-facing, 0.02)  # half: between a pixel's short and long axis
    red, green, blue, gloss, glow_r, glow_g, glow_b = surface(
        material, x, y, z, (nx, ny, nz), wall, colour, footprint, -facing, light
    )
    if material == _FOLIAGE:  # leaves point anywhere, more of them up
        nx += 1.8 * (value_noise(6 * x + 7, 6 * z, 33) - 0.5)
        ny += 1.8 * (value_noise(6 * y, 6 * z + 9, 34) - 0.5)
        nz += 0.3
        norm = np.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx / norm, ny / norm, nz / norm
    sun, sky = received(scene, material, (x, y, z), (nx, ny, nz))
    street, beam = 0.0, 0.0
    if light.lamps > 0:
        street = LAMP_LIGHT * light.lamps * (0.3 + 0.7 * sky) * street_light(scene.lamps, x, y, z, nx, ny, nz)
        beam = BEAM_LIGHT * light.lamps * beam_light(scene.beams, x, y, z, nx, ny, nz)
    red = red * (light.ambient[0] * sky + light.sun[0] * sun + light.lamp_colour[0] * street + beam) + glow_r
    green = green * (light.ambient[1] * sky + light.sun[1] * sun + light.lamp_colour[1] * street + beam) + glow_g
    blue = blue * (light.ambient[2] * sky + light.sun[2] * sun + light.lamp_colour[2] * street + 0.9 * beam) + glow_b
    if gloss > 0:
        rx, ry, rz = dx - 2 * facing * nx, dy - 2 * facing * ny, dz - 2 * facing * nz
        mirror = sky_colour(rx, ry, max(rz, 0.03), light)
        share = gloss * (0.3 + 0.7 * (1 + facing) ** 3)  # more at grazing angles
        red, green, blue = red + mirror[0] * share, green + mirror[1] * share, blue + mirror[2] * share
    haze = 1 - np.exp(-distance / light.haze_m)
    far = sky_colour(dx, dy, 0.0, light)
    return red + (far[0] - red) * haze, green + (far[1] - green) * haze, blue + (far[2] - blue) * haze


@inner
def surface(material, x, y, z, normal, wall, colour, footprint, facing, light):
    """Reflectance (3), gloss and emitted radiance (3) of a surface point; `facing` is the cosine to the viewer."""
    red, green, blue = colour
    if material == _FACADE:
        red, green, blue, gloss, lit, warm = facade(
            x, y, z, normal, wall, footprint, (red, green, blue), light.lit_share
        )
        lit *= light.lamps
        return red, green, blue, gloss, 0.8 * lit, (0.76 - 0.18 * warm) * lit, (0.66 - 0.36 * warm) * lit
    if material in (_GRASS, _FAR_GROUND):
        k, dry = grass(x, y, footprint)
        return red * k * (0.8 + 0.7 * dry), green * k * (0.9 + 0.25 * dry), blue * k, 0.0, 0.0, 0.0, 0.0
    if material in (_WHITE_PAINT, _YELLOW_PAINT):
        gone = wear(x, y)
        k = 1 + 0.2 * band(x, y, 0.35, footprint, 3)
        return (
            k * (red + (0.2 - red) * gone), k * (green + (0.2 - green) * gone), k * (blue + (0.2 - blue) * gone),
            0.0, 0.0, 0.0, 0.0,
        )  # fmt: skip
    k = max(brightness(material, x, y, z, normal, footprint), 0.1)
    red, green, blue = red * k, green * k, blue * k
    if material == _CAR_PAINT:
        return red, green, blue, 0.10, 0.0, 0.0, 0.0
    if material == _CAR_GLASS:
        return red, green, blue, 0.35, 0.0, 0.0, 0.0
    glow_r, glow_g, glow_b = emission(material, red, green, blue, normal[2], wall[0], facing, light)
    return red, green, blue, 0.0, glow_r, glow_g, glow_b


@inner
def emission(material, red, green, blue, up, is_on, facing, light):
    """Radiance (3) of what shines by itself; `up` is the normal's height, `is_on` whether a vehicle is driven."""
    lamps = light.lamps
    if material == _LAMP:
        bright = lamps * (10.0 if up < -0.5 else 2.5)  # glass below, housing above
        return bright * light.lamp_colour[0], bright * light.lamp_colour[1], bright * light.lamp_colour[2]
    if material == _HEAD_LIGHT and is_on > 0:
        bright = lamps * (0.8 + 9 * facing**4)
        return bright, 0.95 * bright, 0.85 * bright
    if material == _TAIL_LIGHT and is_on > 0:
        return 2.5 * lamps, 0.06 * lamps, 0.04 * lamps
    if material == _TRAFFIC_LIGHT and red + green + blue > 0.5:  # the lens that is on
        bright = 1.2 + 1.5 * lamps
        return bright * red, bright * green, bright * blue
    return 0.0, 0.0, 0.0


@spliced
def received(scene, material, point, normal):
    """How much sun (cosine and shadows) and how much of the open sky reach a point."""
    # A step off the surface, so that it does not shade itself.
    x, y, z = point[0] + 0.08 * normal[0], point[1] + 0.08 * normal[1], point[2] + 0.08 * normal[2]
    sky = 0.62 + 0.38 * normal[2]  # walls see half of the sky, and some light from the street
    city = occlusion(scene.shadows.sky, x, y, z, 2.4, 0.5)  # under trees, awnings, balconies
    sky *= 1 - 0.45 * city
    is_low = z < 4.0  # no actor reaches higher
    if is_low:
        sky *= 1 - 0.65 * occlusion(scene.actor_sky, x, y, z, 0.5, 0.1)  # under cars
    if material in (_FACADE, _ROOF, _CURB):
        sky *= 0.75 + 0.25 * min(max(z / 4, 0.0), 1.0)  # narrow streets are darker at the bottom
    to_sun = scene.lighting.to_sun
    sun = normal[0] * to_sun[0] + normal[1] * to_sun[1] + normal[2] * to_sun[2]
    if material == _FOLIAGE and sun < 0:
        sun *= -0.35  # leaves let light through
    if sun <= 0:
        return 0.0, sky
    sun *= 1 - occlusion(scene.shadows.sun, x, y, z, 0.15, 0.2)
    if is_low and sun > 0:
        sun *= 1 - occlusion(scene.actor_sun, x, y, z, 0.1, 0.1)
    return sun, sky


@spliced
def sample_light(scene, view, face, row, column, nearness, samples_a_pixel):
    """Exposure (3) by what one sample sees, 1 at the white point; `view` is in sample coordinates."""
    cx = (column - view.centre_x) / view.focal_x
    cy = (row - view.centre_y) / view.focal_y
    r, light = view.camera_from_world, scene.lighting
    ray = (
        r[0, 0] * cx + r[1, 0] * cy + r[2, 0],
        r[0, 1] * cx + r[1, 1] * cy + r[2, 1],
        r[0, 2] * cx + r[1, 2] * cy + r[2, 2],
    )
    if face < 0:
        stretch = np.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2)
        red, green, blue = sky_colour(ray[0] / stretch, ray[1] / stretch, ray[2] / stretch, light)
    else:
        red, green, blue = shade_point(scene, face, ray, 1.0 / nearness, view.focal_x / samples_a_pixel, view.position)
    gain = light.exposure
    return gain * red * light.balance[0], gain * green * light.balance[1], gain * blue * light.balance[2]


@shader
def shade_view(scene: Scene, view: PinholeView, antialias: bool, nearness, faces, exposure):
    """Fill `exposure` (H, W, 3) float32 from sample buffers: (2 H + 1, 2 W + 1), or (H, W) without antialiasing."""
    height, width = exposure.shape[0], exposure.shape[1]
    for row in range(height):
        for column in range(width):
            y, x = (2 * row + 1, 2 * column + 1) if antialias else (row, column)
            red, green, blue = pixel_light(scene, view, antialias, nearness, faces, y, x)
            exposure[row, column, 0], exposure[row, column, 1], exposure[row, column, 2] = red, green, blue


@spliced
def pixel_light(scene, view, antialias, nearness, faces, row, column):
    """Exposure of the pixel whose centre sample is (row, column); faces are shaded once each."""
    red, green, blue = 0.0, 0.0, 0.0
    done = 0  # bit set of the nine samples
    for order in range(9 if antialias else 1):  # the centre first: it stands for its face
        index = (4, 0, 1, 2, 3, 5, 6, 7, 8)[order]
        if done >> index & 1:
            continue
        y, x = row + index // 3 - 1, column + index % 3 - 1
        face = faces[y, x]
        weight = 0.0 if antialias else 1.0
        for other in range(9 if antialias else 0):
            oy, ox = row + other // 3 - 1, column + other % 3 - 1
            if faces[oy, ox] == face:
                done |= 1 << other
                weight += (2 - abs(oy - row)) * (2 - abs(ox - column)) / 16.0
        r, g, b = sample_light(scene, view, face, y, x, nearness[y, x], 2.0 if antialias else 1.0)
        red, green, blue = red + weight * r, green + weight * g, blue + weight * b
    return red, green, blue
