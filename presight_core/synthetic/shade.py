"""Deferred shading: the colour of every pixel, from the faces that its samples see.

A pixel is the tent-filtered sum of 3 x 3 samples half a pixel apart, its own centre in the middle; each face is
shaded once a pixel, at its first sample, so that edges are smooth and textures stay cheap.
"""

# ruff: noqa: PLR0911, PLR0913, PLR0917 - kernels take plain numbers and leave early

from typing import NamedTuple

import numpy as np

from presight_core.synthetic.jit import inner, kernel, spliced
from presight_core.synthetic.lighting import Lighting
from presight_core.synthetic.materials import Material
from presight_core.synthetic.mesh import Mesh
from presight_core.synthetic.noise import band, hash01, value_noise
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


class Scene(NamedTuple):
    """All that the shader reads."""

    city: Mesh
    actors: Mesh  # its faces are numbered after the city's
    lighting: Lighting
    shadows: Shadows  # of the city
    actor_sun: ShadowMap
    actor_sky: ShadowMap


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
def shade_point(scene, face, ray, depth, focal, position):
    """Radiance towards the camera of a face seen along `ray` (unit depth, world axes) at an optical-axis depth."""
    light = scene.lighting
    mesh = scene.city
    if face >= len(scene.city.faces):
        mesh = scene.actors
        face = face - len(scene.city.faces)
    stretch = np.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2)
    dx, dy, dz = ray[0] / stretch, ray[1] / stretch, ray[2] / stretch
    x, y, z = position[0] + ray[0] * depth, position[1] + ray[1] * depth, position[2] + ray[2] * depth
    distance = depth * stretch
    nx, ny, nz = mesh.normals[face, 0], mesh.normals[face, 1], mesh.normals[face, 2]
    facing = nx * dx + ny * dy + nz * dz
    if facing > 0:  # the back of a leaf
        nx, ny, nz, facing = -nx, -ny, -nz, -facing
    material = mesh.materials[face]
    footprint = distance / focal / max(-facing, 0.08)
    if is_ground(material):
        footprint = 0.5 * distance / focal / max(-facing, 0.02)  # half: between a pixel's short and long axis
    red, green, blue, gloss, glow_r, glow_g, glow_b = surface(
        material, x, y, z, (nx, ny, nz), mesh.walls[face], mesh.colours[face], footprint, light.lamps
    )
    if material == _FOLIAGE:  # leaves point anywhere
        nx += 1.6 * (value_noise(4 * x + 7, 4 * z, 33) - 0.5)
        ny += 1.6 * (value_noise(4 * y, 4 * z + 9, 34) - 0.5)
        norm = np.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx / norm, ny / norm, nz / norm
    sun, sky = received(scene, material, (x, y, z), (nx, ny, nz))
    red = red * (light.ambient[0] * sky + light.sun[0] * sun) + glow_r
    green = green * (light.ambient[1] * sky + light.sun[1] * sun) + glow_g
    blue = blue * (light.ambient[2] * sky + light.sun[2] * sun) + glow_b
    if gloss > 0:
        rx, ry, rz = dx - 2 * facing * nx, dy - 2 * facing * ny, dz - 2 * facing * nz
        mirror = sky_colour(rx, ry, max(rz, 0.03), light)
        share = gloss * (0.3 + 0.7 * (1 + facing) ** 3)  # more at grazing angles
        red, green, blue = red + mirror[0] * share, green + mirror[1] * share, blue + mirror[2] * share
    haze = 1 - np.exp(-distance / light.haze_m)
    far = sky_colour(dx, dy, 0.0, light)
    return red + (far[0] - red) * haze, green + (far[1] - green) * haze, blue + (far[2] - blue) * haze


@inner
def surface(material, x, y, z, normal, wall, colour, footprint, lamps):
    """Reflectance (3), gloss and emitted radiance (3) of a surface point."""
    red, green, blue = float(colour[0]), float(colour[1]), float(colour[2])
    if material == _FACADE:
        red, green, blue, gloss, lit = facade(x, y, z, normal, wall, footprint, (red, green, blue), lamps)
        return red, green, blue, gloss, 0.8 * lit * lamps, 0.62 * lit * lamps, 0.38 * lit * lamps
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
    if material in (_LAMP, _HEAD_LIGHT):
        return red, green, blue, 0.0, 4.0 * lamps, 3.4 * lamps, 2.4 * lamps
    if material == _TAIL_LIGHT:
        return red, green, blue, 0.0, 1.2 * lamps, 0.0, 0.0
    if material == _TRAFFIC_LIGHT and red + green + blue > 0.5:  # the lens that is on
        return red, green, blue, 0.0, 1.2 * red, 1.2 * green, 1.2 * blue
    return red, green, blue, 0.0, 0.0, 0.0, 0.0


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
    if sun <= 0:
        return 0.0, sky
    sun *= 1 - occlusion(scene.shadows.sun, x, y, z, 0.15, 0.2)
    if is_low and sun > 0:
        sun *= 1 - occlusion(scene.actor_sun, x, y, z, 0.1, 0.1)
    return sun, sky


@inner
def display(radiance, exposure):
    """Film-like response: linear in the shadows, no hard clipping in the lights; then the 2.2 display curve."""
    return (1 - np.exp(-max(radiance, 0.0) * exposure)) ** 0.4545


@spliced
def sample_colour(scene, view, face, row, column, nearness):
    """Displayed colour (3) of what one sample sees; `view` is in sample coordinates."""
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
        pixel_focal = 0.5 * view.focal_x  # samples are half a pixel apart
        red, green, blue = shade_point(scene, face, ray, 1.0 / nearness, pixel_focal, view.position)
    return (
        display(red * light.balance[0], light.exposure),
        display(green * light.balance[1], light.exposure),
        display(blue * light.balance[2], light.exposure),
    )


@kernel
def shade_view(scene: Scene, view: PinholeView, nearness, faces, seed: int, rgb):
    """Fill `rgb` (H, W, 3) uint8 from sample buffers (2 H + 1, 2 W + 1)."""
    height, width = rgb.shape[0], rgb.shape[1]
    noise = scene.lighting.noise
    for row in range(height):
        for column in range(width):
            red, green, blue = pixel_colour(scene, view, nearness, faces, 2 * row + 1, 2 * column + 1)
            off_x, off_y = (column - width / 2) / width, (row - height / 2) / width
            falloff = 1 - 0.5 * (off_x * off_x + off_y * off_y)  # vignetting
            for channel, value in enumerate((red, green, blue)):
                grain = hash01(3 * column + channel, row, seed) + hash01(3 * column + channel, row, seed + 1) - 1
                seen = value * falloff + 2.4 * noise * grain * (0.35 + value)  # 2.4: two uniforms to one sigma
                rgb[row, column, channel] = np.uint8(min(max(seen * 255 + 0.5, 0.0), 255.0))


@spliced
def pixel_colour(scene, view, nearness, faces, row, column):
    """Tent-filtered colour of the pixel whose centre sample is (row, column); faces are shaded once each."""
    red, green, blue = 0.0, 0.0, 0.0
    done = 0  # bit set of the nine samples
    for order in range(9):  # the centre first: it stands for its face
        index = (4, 0, 1, 2, 3, 5, 6, 7, 8)[order]
        if done >> index & 1:
            continue
        y, x = row + index // 3 - 1, column + index % 3 - 1
        face = faces[y, x]
        weight = 0.0
        for other in range(9):
            oy, ox = row + other // 3 - 1, column + other % 3 - 1
            if faces[oy, ox] == face:
                done |= 1 << other
                weight += (2 - abs(oy - row)) * (2 - abs(ox - column)) / 16.0
        r, g, b = sample_colour(scene, view, face, y, x, nearness[y, x])
        red, green, blue = red + weight * r, green + weight * g, blue + weight * b
    return red, green, blue
