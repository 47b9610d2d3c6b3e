"""Light: sun, sky, lamps and camera response of a drive, as plain numbers that the kernels read."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

KINDS = ("day", "overcast", "dusk", "night")

Colour = tuple[float, float, float]
SODIUM, LED = np.array([1.0, 0.58, 0.24]), np.array([0.95, 0.88, 0.78])  # street lamps, old and new


class Lighting(NamedTuple):
    """One drive's light; radiances are relative, 1 is about a sunlit grey card divided by its reflectance."""

    to_sun: Colour  # unit vector
    sun: Colour
    ambient: Colour  # from above, without occlusion
    horizon: Colour  # sky radiance
    zenith: Colour
    glow: float  # of the sky around the sun
    clouds: float  # cover in 0..1
    haze_m: float  # distance at which haze takes 63 %
    lamps: float  # brightness of street lamps, head lights and windows; 0: all off
    lamp_colour: Colour  # of street lamps: sodium to LED
    lit_share: float  # of windows
    exposure: float
    balance: Colour  # of the camera's channels
    shot_noise: float  # variance a unit of light
    read_noise: float  # standard deviation in the dark
    blur: float  # of long exposures, sigma in image widths


class _Recipe(NamedTuple):
    """Ranges that a kind of light is drawn from; elevation in radians above the horizon."""

    elevation: tuple[float, float]
    sun: Colour
    ambient: Colour
    horizon: Colour
    zenith: Colour
    glow: float
    clouds: tuple[float, float]
    haze_m: float
    lamps: float
    lit_share: float
    exposure: float
    shot_noise: float
    read_noise: float
    blur: float


_RECIPES = {
    "day": _Recipe((0.6, 1.1), (2.3, 2.2, 2.0), (0.75, 0.85, 1.0), (0.75, 0.85, 0.95), (0.25, 0.45, 0.85),
                   0.6, (0.2, 0.8), 900.0, 0.0, 0.0, 0.82, 3e-4, 0.001, 0.0),
    "overcast": _Recipe((0.8, 1.1), (0.30, 0.30, 0.30), (1.10, 1.15, 1.22), (1.35, 1.38, 1.42), (1.05, 1.10, 1.17),
                        0.1, (0.3, 0.9), 800.0, 0.0, 0.0, 0.82, 4e-4, 0.0015, 0.0),
    "dusk": _Recipe((0.12, 0.25), (1.8, 1.00, 0.52), (0.34, 0.36, 0.50), (1.0, 0.60, 0.36), (0.20, 0.27, 0.52),
                    1.2, (0.4, 0.9), 900.0, 0.7, 0.3, 1.0, 8e-4, 0.003, 0.0),
    "night": _Recipe((0.5, 1.0), (0.0, 0.0, 0.0), (0.013, 0.013, 0.018), (0.050, 0.040, 0.034),
                     (0.009, 0.010, 0.016), 0.0, (0.0, 0.8), 900.0, 1.0, 0.4, 1.7, 4e-3, 0.014, 0.0012),
}  # fmt: skip


def sample_lighting(kind: str, rng: np.random.Generator) -> Lighting:
    """One drive's light of a kind in KINDS: sun, clouds, exposure and white balance vary."""
    recipe = _RECIPES[kind]
    azimuth, elevation = rng.uniform(0, 2 * np.pi), rng.uniform(*recipe.elevation)
    balance = np.exp(rng.normal(0, 0.05, 3))  # 5 %: automatic white balance is seldom better
    clouds = float(rng.uniform(*recipe.clouds))
    exposure = float(recipe.exposure * np.exp(rng.normal(0, 0.10)))  # 10 %: automatic exposure
    whiteness = rng.random()
    return Lighting(
        to_sun=_colour([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]),
        sun=recipe.sun,
        ambient=recipe.ambient,
        horizon=recipe.horizon,
        zenith=recipe.zenith,
        glow=recipe.glow,
        clouds=clouds,
        haze_m=recipe.haze_m,
        lamps=recipe.lamps,
        lamp_colour=_colour(SODIUM + (LED - SODIUM) * whiteness),
        lit_share=recipe.lit_share,
        exposure=exposure,
        balance=_colour(balance / balance.mean()),
        shot_noise=recipe.shot_noise,
        read_noise=recipe.read_noise,
        blur=recipe.blur,
    )


def light_axes(to_light: Colour) -> NDArray[np.float64]:
    """Rows u, v, light (3, 3): an orthonormal frame whose last axis points to the light."""
    light = np.asarray(to_light, np.float64)
    helper = np.array([0.0, 0.0, 1.0]) if abs(light[2]) < 0.99 else np.array([1.0, 0.0, 0.0])
    u = np.cross(helper, light)
    u /= np.linalg.norm(u)
    return np.stack([u, np.cross(light, u), light])


def _colour(values: object) -> Colour:
    red, green, blue = np.asarray(values, np.float64).tolist()
    return red, green, blue
