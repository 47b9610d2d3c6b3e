"""Entropy coding of quantised transform coefficients: an adaptive binary range coder with contexts.

Every magnitude is written as a row of yes-or-no questions ("is it more than 0?", "more than 1?", ...). How likely a
yes is, is learnt on the way, apart for each context: how large the neighbours are that came before, and how high the
frequency is. The decoder asks the same questions and so learns the same. The arithmetic is that of the LZMA coder.
"""

import numba
import numpy as np
from numpy.typing import NDArray

BLOCK = 8  # coefficients a side
NEIGHBOUR_LEVELS = 16
BANDS = 8  # of frequency: row + column of the coefficient, the highest ones together
QUESTIONS = 15  # larger magnitudes go on in an Elias-gamma code
TOP = 1 << 24  # the range never falls below this, so that a probability of 12 bits always splits it
FULL = 0xFFFFFFFF
HALF = 1 << 15  # a probability of one half, in 16 bits
FAST, SLOW = 4, 7  # shifts of the two running averages whose mean is the probability: one adapts, one is exact
LONGEST_GAMMA = 24  # bits; more is damage

# Which level a weighted sum of neighbours belongs to; steps grow with the sum, as its noise does.
_LEVEL_STARTS = (1, 2, 3, 5, 7, 9, 12, 16, 21, 28, 38, 52, 72, 110, 200)
_LARGEST_SUM = 255
LEVELS = np.searchsorted(_LEVEL_STARTS, np.arange(_LARGEST_SUM + 1), side="right").astype(np.uint8)

_kernel = numba.njit(nogil=True, cache=True)
_inner = numba.njit(inline="always")


def encode(coefficients: NDArray[np.int32]) -> bytes:
    """The code of coefficients (channels, block rows, block columns, 8, 8)."""
    room = np.empty(coefficients.size * 4 + 64, np.uint8)  # 4 bytes each is more than any coefficient can take
    return room[: _encode(np.ascontiguousarray(coefficients, np.int32), room, LEVELS)].tobytes()


def decode(content: bytes, shape: tuple[int, ...]) -> NDArray[np.int32]:
    """The coefficients of a code. A damaged code gives wrong numbers or a ValueError, never a crash or a hang."""
    coefficients = np.zeros(shape, np.int32)
    if not _decode(np.frombuffer(content, np.uint8), coefficients, LEVELS):
        raise ValueError("the code of the features is damaged")
    return coefficients


@_inner
def _context(values, place, levels):
    """The context of a coefficient, from those before it: in its block, in the blocks beside, in the channels before.

    The weights say how well each neighbour foretells a magnitude; they were measured once, on three networks.
    """
    channel, row, column, u, v = place
    total = 0
    if u > 0:
        total += 4 * abs(values[channel, row, column, u - 1, v])
    if v > 0:
        total += 4 * abs(values[channel, row, column, u, v - 1])
    if u > 0 and v > 0:
        total += 2 * abs(values[channel, row, column, u - 1, v - 1])
    if u > 1:
        total += 2 * abs(values[channel, row, column, u - 2, v])
    if v > 1:
        total += 2 * abs(values[channel, row, column, u, v - 2])
    if row > 0:
        total += 3 * abs(values[channel, row - 1, column, u, v])
    if column > 0:
        total += 3 * abs(values[channel, row, column - 1, u, v])
    if channel > 0:
        total += 2 * abs(values[channel - 1, row, column, u, v])
    if channel > 1:
        total += abs(values[channel - 2, row, column, u, v])
    return min(u + v, BANDS - 1) * NEIGHBOUR_LEVELS + levels[min(total, _LARGEST_SUM)]


@_inner
def _chance(model):
    """The probability of a yes, in 12 bits and never certain."""
    return min(max((model[0] + model[1]) >> 5, 16), 4080)


@_inner
def _learn(model, bit):
    target = 65535 if bit else 0
    model[0] += (target - model[0]) >> FAST
    model[1] += (target - model[1]) >> SLOW


@_inner
def _new_models():
    return np.full((BANDS * NEIGHBOUR_LEVELS, QUESTIONS, 2), HALF, np.int64)


@_inner
def _shift_out(state, room):
    """Move the top byte of the low end to the output; a later carry may still run through bytes of 255."""
    low, waiting, count, position = state[0], state[2], state[3], state[4]
    if low < 0xFF000000 or low > FULL:  # no later carry can reach what waits
        carry = low >> 32
        room[position] = (waiting + carry) & 0xFF
        position += 1
        for _ in range(count - 1):
            room[position] = (0xFF + carry) & 0xFF
            position += 1
        count = 0
        waiting = (low >> 24) & 0xFF
    state[0], state[2], state[3], state[4] = (low & 0x00FFFFFF) << 8, waiting, count + 1, position


@_inner
def _put(state, room, model, bit):
    bound = (state[1] >> 12) * _chance(model)
    if bit:
        state[1] = bound
    else:
        state[0] += bound
        state[1] -= bound
    _learn(model, bit)
    while state[1] < TOP:
        state[1] = (state[1] << 8) & FULL
        _shift_out(state, room)


@_inner
def _put_plain(state, room, bit):
    state[1] >>= 1
    if bit:
        state[0] += state[1]
    while state[1] < TOP:
        state[1] = (state[1] << 8) & FULL
        _shift_out(state, room)


@_kernel
def _encode(values, room, levels):
    models = _new_models()
    state = np.array([0, FULL, 0, 1, 0], np.int64)  # low, range, waiting byte, bytes waiting, position
    for channel, row, column, u, v in np.ndindex(values.shape):
        context = models[_context(values, (channel, row, column, u, v), levels)]
        value = values[channel, row, column, u, v]
        size = abs(value)
        for question in range(QUESTIONS):
            _put(state, room, context[question], size > question)
            if size <= question:
                break
        if size >= QUESTIONS:
            _put_gamma(state, room, size - QUESTIONS + 1)
        if size > 0:
            _put_plain(state, room, value < 0)
    for _ in range(5):
        _shift_out(state, room)
    return state[4]


@_inner
def _put_gamma(state, room, number):
    bits = 0
    while number >> (bits + 1):
        bits += 1
        _put_plain(state, room, True)
    _put_plain(state, room, False)
    for bit in range(bits - 1, -1, -1):
        _put_plain(state, room, (number >> bit) & 1)


@_inner
def _refill(state, content):
    while state[1] < TOP:
        byte = content[state[2]] if state[2] < len(content) else 0
        state[0] = ((state[0] << 8) | byte) & FULL
        state[1] = (state[1] << 8) & FULL
        state[2] += 1


@_inner
def _get(state, content, model):
    bound = (state[1] >> 12) * _chance(model)
    bit = state[0] < bound
    if bit:
        state[1] = bound
    else:
        state[0] -= bound
        state[1] -= bound
    _learn(model, bit)
    _refill(state, content)
    return bit


@_inner
def _get_plain(state, content):
    state[1] >>= 1
    bit = state[0] >= state[1]
    if bit:
        state[0] -= state[1]
    _refill(state, content)
    return bit


@_kernel
def _decode(content, values, levels):
    models = _new_models()
    state = np.array([0, FULL, 1], np.int64)  # code, range, position: the first byte is always 0
    for _ in range(4):
        byte = content[state[2]] if state[2] < len(content) else 0
        state[0] = (state[0] << 8) | byte
        state[2] += 1
    for channel, row, column, u, v in np.ndindex(values.shape):
        context = models[_context(values, (channel, row, column, u, v), levels)]
        size = 0
        while size < QUESTIONS and _get(state, content, context[size]):
            size += 1
        if size == QUESTIONS:
            bits = 0
            while _get_plain(state, content):
                bits += 1
                if bits > LONGEST_GAMMA:
                    return False
            number = 1
            for _ in range(bits):
                number = (number << 1) | (1 if _get_plain(state, content) else 0)
            size += number - 1
        if size > 0:
            values[channel, row, column, u, v] = -size if _get_plain(state, content) else size
    return True
