"""The compact code of a feature map: at most 60 kB an image at the paper's grid of 72 x 128 x 64.

As image codecs do it: blocks of 8 x 8 patches of a channel go through the cosine transform, the coefficients are
divided by a step and rounded, and what remains is entropy-coded with contexts. The step is FINEST_STEP, or larger
where the code would not stay below the limit. Channels that explain more of the model's variance have finer steps,
but only somewhat: a field is trained on the scaled features, where all channels count alike. docs/decisions/010
argues and measures the choice.

    header   version, rows, columns, channels, step of each channel (float16), mean of each channel (uint8)
    body     the range coder's bytes
"""

import struct

import numpy as np
from numpy.typing import ArrayLike, NDArray

from presight_core.feature_codec import range_coder
from presight_core.feature_codec.range_coder import BLOCK

VERSION = 1
HEADER = struct.Struct("<BHHH")
PAPER_VALUES = 72 * 128 * 64
LARGEST_BYTES = 57_000  # at the paper's grid and below: 60 kB an image, less 3 kB for its label map
FINEST_STEP = 32.0  # of 255: the error is then a fifth of a channel's deviation, the centred cosine 0.98
WEIGHT_EXPONENT = 0.25  # of a channel's range: where both kinds of error are small (docs/decisions/010)
LEAST_BYTES = 64  # of a body, however small the grid
ROUNDING = 0.38  # instead of 0.5: a small coefficient costs more bits than it mends error
BITS_PER_COEFFICIENT = 4.5  # that is not 0: the first guess at a step; 4.2 to 4.9 were measured
LARGEST_VALUES = 1 << 26  # of a header that can be true: 64 MB, a hundred times the paper's grid


def channel_weights(ranges: ArrayLike) -> NDArray[np.float32]:
    """How fine each channel (C,) shall be, the mean (geometric) being 1, from the width of its range in the space."""
    logarithm = np.log(np.maximum(np.asarray(ranges, np.float64), 1e-12))
    return np.exp(WEIGHT_EXPONENT * (logarithm - logarithm.mean())).astype(np.float32)


def encode(features: NDArray[np.uint8], weights: ArrayLike, limit_bytes: int | None = None) -> bytes:
    """The compact code of features (rows, columns, C), of at most `limit_bytes`.

    If not given, these are 57 kB, and as many more as the grid is larger than the paper's.
    """
    rows, columns, channels = features.shape
    weights = np.asarray(weights, np.float32)
    means = np.round(features.mean((0, 1))).astype(np.uint8)
    coefficients = _transformed(features - means.astype(np.float32)) * weights[:, None, None, None, None]
    header = HEADER.pack(VERSION, rows, columns, channels)
    limit_bytes = limit_bytes or round(LARGEST_BYTES * max(1.0, features.size / PAPER_VALUES))
    limit = max(LEAST_BYTES, limit_bytes - len(header) - 3 * channels)
    step = max(FINEST_STEP, _first_step(coefficients, limit))
    while True:
        steps = (step / weights).astype(np.float16)
        quantised = _quantised(coefficients, steps * weights)
        code = range_coder.encode(quantised)
        if len(code) <= limit or not quantised.any():
            return header + steps.tobytes() + means.tobytes() + code
        step *= max((len(code) / limit) ** 0.75, 1.01)  # the size falls a little faster than 1 / step


def decode(content: bytes) -> NDArray[np.uint8]:
    """Features (rows, columns, C), about as they were. Raises ValueError for what `encode` never wrote."""
    try:
        version, rows, columns, channels = HEADER.unpack_from(content)
    except struct.error as error:
        raise ValueError(f"{len(content)} bytes are no compact features") from error
    start = HEADER.size + 3 * channels
    if version != VERSION or rows * columns * channels > LARGEST_VALUES or len(content) < start:
        raise ValueError(f"compact features of version {version} and size {rows} x {columns} x {channels}")
    steps = np.frombuffer(content, np.float16, channels, HEADER.size).astype(np.float32)
    means = np.frombuffer(content, np.uint8, channels, HEADER.size + 2 * channels).astype(np.float32)
    shape = (channels, -(-rows // BLOCK), -(-columns // BLOCK), BLOCK, BLOCK)
    coefficients = range_coder.decode(content[start:], shape) * steps[:, None, None, None, None]
    values = _restored(coefficients)[:rows, :columns] + means
    return np.round(np.clip(values, 0, 255)).astype(np.uint8)


def _first_step(coefficients: NDArray[np.float32], limit_bytes: int) -> float:
    """The step that leaves about as many coefficients as the limit has room for."""
    room = int(limit_bytes * 8 / BITS_PER_COEFFICIENT)
    if room >= coefficients.size:
        return FINEST_STEP
    place = coefficients.size - max(room, 1)
    return float(np.partition(np.abs(coefficients), place, axis=None)[place]) / (1 - ROUNDING)


def _quantised(coefficients: NDArray[np.float32], steps: NDArray[np.float32]) -> NDArray[np.int32]:
    whole = np.floor(np.abs(coefficients) / steps[:, None, None, None, None] + ROUNDING)
    return np.copysign(whole, coefficients).astype(np.int32)


def _transformed(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Coefficients (C, block rows, block columns, 8, 8) of values (rows, columns, C), padded with their edges."""
    from scipy.fft import dctn

    rows, columns, channels = values.shape
    padded = np.pad(values, ((0, -rows % BLOCK), (0, -columns % BLOCK), (0, 0)), mode="edge")
    blocks = padded.reshape(padded.shape[0] // BLOCK, BLOCK, padded.shape[1] // BLOCK, BLOCK, channels)
    return np.asarray(dctn(np.ascontiguousarray(blocks.transpose(4, 0, 2, 1, 3)), axes=(3, 4), norm="ortho"))


def _restored(coefficients: NDArray[np.float32]) -> NDArray[np.float32]:
    """Values (rows, columns, C) of coefficients, whole blocks."""
    from scipy.fft import idctn

    blocks = np.asarray(idctn(coefficients, axes=(3, 4), norm="ortho")).transpose(1, 3, 2, 4, 0)
    return blocks.reshape(blocks.shape[0] * BLOCK, blocks.shape[2] * BLOCK, blocks.shape[4])
