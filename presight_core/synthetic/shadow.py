"""Shadow maps: what parallel light reaches, for the sun and, straight from above, for the open sky."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from presight_core.synthetic.jit import inner
from presight_core.synthetic.lighting import Colour, Lighting, light_axes
from presight_core.synthetic.mesh import Mesh
from presight_core.synthetic.raster import draw_orthographic

SUN_SAMPLE_M = 0.15
SKY_SAMPLE_M = 0.30
ZENITH: Colour = (0.0, 0.0, 1.0)
NOTHING = -1e9  # height along the light where no face is


class ShadowMap(NamedTuple):
    """Greatest height along the light per sample; sample = (axes[:2] @ point - origin) / sample_m."""

    axes: NDArray[np.float64]  # (3, 3) rows u, v, towards the light
    origin: NDArray[np.float64]  # (2,)
    sample_m: float
    height_m: NDArray[np.float32]  # (N, N)


class Shadows(NamedTuple):
    """Shadows of the standing city around one place."""

    sun: ShadowMap
    sky: ShadowMap


def shadow_map(mesh: Mesh, to_light: Colour, centre: ArrayLike, radius_m: float, sample_m: float) -> ShadowMap:
    """The shadow map of a mesh within a radius of a place (3,)."""
    axes = light_axes(to_light)
    count = max(int(2 * radius_m / sample_m), 1)
    origin = axes[:2] @ np.asarray(centre, np.float64) - radius_m
    height_m = np.full((count, count), NOTHING, np.float32)
    if len(mesh.faces):
        draw_orthographic(mesh, axes, origin, sample_m, height_m, np.empty((count, count), np.int32))
    return ShadowMap(axes, origin, sample_m, height_m)


def cast_shadows(mesh: Mesh, lighting: Lighting, centre: ArrayLike, radius_m: float) -> Shadows:
    """Sun and sky shadows of the city within a radius of a place; beyond it everything is lit."""
    sun_radius_m = radius_m if max(lighting.sun) > 0 else 0.0  # no sun, no shadows
    sun = shadow_map(mesh, lighting.to_sun, centre, sun_radius_m, SUN_SAMPLE_M)
    return Shadows(sun, shadow_map(mesh, ZENITH, centre, radius_m, SKY_SAMPLE_M))


@inner
def occlusion(shadow, x, y, z, spread_m, bias_m):
    """Share of light that is blocked at a point, 0..1, from four bilinear taps `spread_m` apart."""
    axes = shadow.axes
    u = (axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z - shadow.origin[0]) / shadow.sample_m
    v = (axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z - shadow.origin[1]) / shadow.sample_m
    threshold = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z + bias_m
    reach = 0.5 * spread_m / shadow.sample_m
    total = blocked(shadow.height_m, u - reach, v - 0.4 * reach, threshold)
    total += blocked(shadow.height_m, u + 0.4 * reach, v - reach, threshold)
    total += blocked(shadow.height_m, u + reach, v + 0.4 * reach, threshold)
    total += blocked(shadow.height_m, u - 0.4 * reach, v + reach, threshold)
    return total / 4


@inner
def blocked(height_m, u, v, threshold):
    """Bilinear share of the four samples around (u, v) that stand above a threshold."""
    column, row = int(np.floor(u)), int(np.floor(v))
    if column < 0 or row < 0 or column + 1 >= height_m.shape[1] or row + 1 >= height_m.shape[0]:
        return 0.0
    a, b = u - column, v - row
    low = (height_m[row, column] > threshold) * (1 - a) + (height_m[row, column + 1] > threshold) * a
    high = (height_m[row + 1, column] > threshold) * (1 - a) + (height_m[row + 1, column + 1] > threshold) * a
    return low * (1 - b) + high * b
