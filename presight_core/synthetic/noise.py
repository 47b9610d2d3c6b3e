"""Hashed value noise: texture that costs no memory and is the same on every run."""

import numpy as np

from presight_core.synthetic.jit import typed


@typed("float64(int64, int64, int64)", python=True)
def hash01(x: int, y: int, seed: int) -> float:
    """A number in [0, 1) that looks random, of two integers and a seed."""
    # Odd 32-bit constants with well spread bits (the primes of xxHash), then two xor-shift-multiply rounds.
    h = np.uint32(x) * np.uint32(374761393) + np.uint32(y) * np.uint32(668265263)
    h += np.uint32(seed) * np.uint32(2246822519)
    h = (h ^ (h >> np.uint32(13))) * np.uint32(1274126177)
    h ^= h >> np.uint32(16)
    return np.float64(h & np.uint32(0xFFFFFF)) / 16777216.0  # 2^24


@typed("float64(float64, float64, int64)")
def value_noise(x: float, y: float, seed: int) -> float:
    """Smooth noise in [0, 1) of wavelength about 1."""
    column, row = int(np.floor(x)), int(np.floor(y))
    u, v = x - column, y - row
    u = u * u * (3 - 2 * u)
    v = v * v * (3 - 2 * v)
    low = hash01(column, row, seed) * (1 - u) + hash01(column + 1, row, seed) * u
    high = hash01(column, row + 1, seed) * (1 - u) + hash01(column + 1, row + 1, seed) * u
    return low * (1 - v) + high * v


@typed("float64(float64, float64)")
def detail_strength(wavelength_m: float, footprint_m: float) -> float:
    """How much of a detail survives a pixel of the given footprint: 1 when fine, 0 when under-sampled."""
    return min(max(1.5 - 3 * footprint_m / wavelength_m, 0.0), 1.0)  # gone at half a wavelength a pixel (Nyquist)


@typed("float64(float64, float64, float64, float64, int64)")
def band(x: float, y: float, wavelength_m: float, footprint_m: float, seed: int) -> float:
    """Zero-mean noise in [-0.5, 0.5) of one wavelength, faded out where pixels cannot carry it."""
    strength = detail_strength(wavelength_m, footprint_m)
    if strength <= 0:
        return 0.0
    return (value_noise(x / wavelength_m, y / wavelength_m, seed) - 0.5) * strength
