"""From light on the sensor to an 8-bit image: glow around lamps, film-like response, noise, vignetting."""

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from presight_core.synthetic.jit import shader
from presight_core.synthetic.lighting import Lighting
from presight_core.synthetic.noise import hash01

# Glow around lamps: radius in image widths, share of the light over the white point that goes there.
NARROW, WIDE = (0.004, 0.30), (0.03, 0.10)
WIDE_STEP = 4  # wide glow is blurred on an image this many times smaller

# The 2.2 display curve over the square root of the film's response: even steps, and cheaper than powers.
_DISPLAY = np.round(np.linspace(0, 1, 2048) ** (2 / 2.2) * 255).astype(np.uint8)


def develop(exposure: NDArray[np.float32], lighting: Lighting, seed: int) -> NDArray[np.uint8]:
    """The image (H, W, 3) of an exposure (H, W, 3), 1 at the white point; `seed` decides the noise."""
    if lighting.lamps > 0:
        exposure = _with_glow(exposure)
    if lighting.blur > 0:
        exposure = _blurred(exposure, lighting.blur * exposure.shape[1])
    rgb = np.empty(exposure.shape, np.uint8)
    _expose(exposure, lighting.shot_noise, lighting.read_noise, seed, _DISPLAY, rgb)
    return rgb


def _with_glow(exposure: NDArray[np.float32]) -> NDArray[np.float32]:
    height, width = exposure.shape[:2]
    over = np.maximum(exposure - 1, np.float32(0))
    narrow = _blurred(over, NARROW[0] * width)
    small = cv2.resize(over, (-(-width // WIDE_STEP), -(-height // WIDE_STEP)), interpolation=cv2.INTER_AREA)
    wide = cv2.resize(_blurred(small, WIDE[0] * width / WIDE_STEP), (width, height))
    return (exposure + NARROW[1] * narrow + WIDE[1] * wide).astype(np.float32)


def _blurred(image: ArrayLike, sigma_px: float) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(np.asarray(image), (0, 0), sigma_px), np.float32)


@shader
def _expose(exposure, shot_noise: float, read_noise: float, seed: int, display, rgb):
    """Film: linear in the shadows, no hard clipping in the lights, then the 2.2 display curve.

    Shot noise varies from pixel to pixel; read noise comes in blotches of two pixels, as demosaicing leaves it.
    """
    height, width, last = rgb.shape[0], rgb.shape[1], len(display) - 1
    for row in range(height):
        for column in range(width):
            off_x, off_y = (column - width / 2) / width, (row - height / 2) / width
            falloff = 1 - 1.1 * (off_x * off_x + off_y * off_y)  # vignetting
            for channel in range(3):
                film = (1 - np.exp(-exposure[row, column, channel])) * falloff
                shot = hash01(3 * column + channel, row, seed) - 0.5
                read = hash01(3 * (column // 2) + channel, row // 2, seed + 1) - 0.5
                film += 3.46 * (shot * np.sqrt(shot_noise * film) + read * read_noise)  # 3.46: uniform to one sigma
                rgb[row, column, channel] = display[int(np.sqrt(min(max(film, 0.0), 1.0)) * last + 0.5)]
