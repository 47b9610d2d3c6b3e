"""Density along rays on a CPU, without gradients: places, encoding and network in one pass.

Operator by operator, most of the time goes into rows that are written, sorted and read again. Here some thousand
samples at a time go through everything while they are in the cache, and a ray ends where it is followed no further.
"""

import math
import os

import numba
import numpy as np
import torch
from jaxtyping import Float
from llvmlite import ir
from numba import prange, types
from numba.core import cgutils
from numba.extending import intrinsic
from torch import Tensor
from torch.nn import functional

from presight_core.field.early_stop import samples_of_stage
from presight_core.field.hash_encode.numba_kernels import corner_scratch, encode_rows
from presight_core.field.hash_grid import HashGrid
from presight_core.field.mlp import SubFieldMlp
from presight_core.field.rays import Rays
from presight_core.field.rendering import LARGEST_EXPONENT

POINTS = 4096  # that go through together: of 40 float32 they take 640 KiB of a second-level cache
LANES = 16  # hidden values that are calculated at once, each for
TOGETHER = 4  # samples: what adds up stays in registers
MOST = np.float32(LARGEST_EXPONENT)
FLOAT, INT64 = ir.FloatType(), ir.IntType(64)
VECTOR = ir.VectorType(FLOAT, LANES)
# Sums in any order; but what is no number, or without end, stays so.
FAST = {"reassoc", "contract", "nsz", "arcp"}


def suits(grid: HashGrid, edges_m: Tensor) -> bool:
    """Whether `ray_density` can be asked: on a CPU where no gradient is wanted."""
    is_plain = grid.copy is None and os.environ.get("TRITON_INTERPRET") != "1"
    return edges_m.device.type == "cpu" and not torch.is_grad_enabled() and is_plain


def ray_density(  # noqa: PLR0913, PLR0917 - all that a density depends on
    grid: HashGrid,
    network: SubFieldMlp,
    boxes: tuple[Tensor, Tensor, Tensor],
    rays: Rays,
    edges_m: Float[Tensor, "rays edges"],
    density_bias: float,
    left: float = 0.0,
    fog: float = 0.0,
) -> Float[Tensor, "rays bins"]:
    """Density per metre in the middle of each bin; zero beyond where at most `left` of a ray is left.

    What is thinner than `fog` counts as nothing.

    `boxes` are centroids, centres and half sizes (sub-fields, 3) of the sub-fields, field frame, metres. The network
    has one hidden layer; its first output is the density's logarithm, less `density_bias`.
    """
    bins = edges_m.shape[1] - 1
    stage = samples_of_stage(bins) if left else bins
    most = -math.log(left) if left else math.inf
    density = torch.zeros_like(edges_m[:, 1:])
    _fill(
        _arrays(rays.origins, rays.directions, edges_m),
        _arrays(*boxes),
        _arrays(grid.table, grid.offsets, grid.levels),
        _layers(network),
        (np.float32(density_bias), np.float32(most), np.float32(fog)),
        stage,
        density.numpy(),
        numba.get_num_threads(),
    )
    return density


def _arrays(*tensors: Tensor) -> tuple[np.ndarray, ...]:
    return tuple(tensor.detach().contiguous().numpy() for tensor in tensors)


def _layers(network: SubFieldMlp) -> tuple[np.ndarray, ...]:
    """Weights (sub-fields, inputs, hidden) and biases of the hidden layer, then those (sub-fields, hidden) of density.

    The hidden layer is padded with zeros to a multiple of LANES.
    """
    hidden, output = network.weights
    values = hidden.detach().transpose(1, 2), network.biases[0].detach(), output[:, 0].detach()
    padding = 0, -hidden.shape[1] % LANES
    return _arrays(*(functional.pad(value, padding) for value in values), network.biases[1][:, 0])


# Numba's cache sees changes of this file only: after one of `encode_rows`, touch it.
@numba.njit(parallel=True, cache=True, error_model="numpy", fastmath=FAST)
def _fill(rays, boxes, grid, layers, limits, stage, density, worker_count):  # noqa: PLR0913, PLR0917 - numba wants arrays
    """Workers take equal shares of the rays."""
    ray_count = len(density)
    share = (ray_count + worker_count - 1) // worker_count
    step = max(1, POINTS // stage)
    for worker in prange(worker_count):
        work = _work(max(POINTS, stage), len(boxes[0]), layers)
        end = min((worker + 1) * share, ray_count)
        for first in range(worker * share, end, step):
            last = min(first + step, end)
            _follow(rays, first, last, boxes, grid, layers, limits, stage, density, work)


@numba.njit(error_model="numpy")
def _follow(rays, first, last, boxes, grid, layers, limits, stage, density, work):  # noqa: PLR0913, PLR0917 - likewise
    """Rays first..last through a stage after the other, as long as less than `most` optical depth is behind them."""
    density_bias, most, fog = limits
    followed = np.arange(first, last)
    optical = np.zeros(len(followed), np.float32)
    for low in range(0, density.shape[1], stage):
        high = min(low + stage, density.shape[1])
        _place(rays, followed, low, high, boxes, work)
        _encode(grid, work)
        _infer(layers, work)
        _note(rays[2], followed, low, high, density_bias, fog, work, density, optical)
        unfinished = optical < most
        followed, optical = followed[unfinished], optical[unfinished]


@numba.njit
def _work(points, sub_fields, layers):
    """Of each sample: sub-field, row once sorted; sorted: position, whether it has one, encoding, output.

    And the segments of the sub-fields, and what the encoding needs.
    """
    return (
        np.empty(points, np.int64),
        np.empty(points, np.int64),
        np.empty((3, points), np.float32),
        np.empty(points, np.bool_),
        np.zeros((points + TOGETHER, layers[0].shape[1]), np.float32),
        np.empty(points + TOGETHER, np.float32),
        np.zeros(sub_fields + 1, np.int64),
        corner_scratch(),
    )


@numba.njit(error_model="numpy", fastmath=FAST)
def _place(rays, followed, low, high, boxes, work):
    """Sort samples low..high of the followed rays by sub-field, and find their positions in its grid."""
    origins, directions, edges_m = rays
    centroids, centres, half_sizes = boxes
    owner, row, positions, inside, _, _, segments, _ = work
    sub_fields = len(centroids)
    one, two, half, quarter = np.float32(1), np.float32(2), np.float32(0.5), np.float32(0.25)
    segments[:] = 0
    n = 0
    for ray in followed:
        for bin in range(low, high):
            metres = (edges_m[ray, bin] + edges_m[ray, bin + 1]) * half
            nearest, least = 0, np.float32(np.inf)
            for s in range(sub_fields):
                x = origins[ray, 0] + metres * directions[ray, 0] - centroids[s, 0]
                y = origins[ray, 1] + metres * directions[ray, 1] - centroids[s, 1]
                z = origins[ray, 2] + metres * directions[ray, 2] - centroids[s, 2]
                distance = x * x + y * y + z * z
                if distance < least:
                    nearest, least = s, distance
            owner[n] = nearest
            segments[nearest + 1] += 1
            n += 1
    for s in range(sub_fields):
        segments[s + 1] += segments[s]
    filled = segments.copy()
    n = 0
    for ray in followed:
        for bin in range(low, high):
            metres = (edges_m[ray, bin] + edges_m[ray, bin + 1]) * half
            s = owner[n]
            i = filled[s]
            filled[s] += 1
            row[n] = i
            n += 1
            x = (origins[ray, 0] + metres * directions[ray, 0] - centres[s, 0]) / half_sizes[s, 0]
            y = (origins[ray, 1] + metres * directions[ray, 1] - centres[s, 1]) / half_sizes[s, 1]
            z = (origins[ray, 2] + metres * directions[ray, 2] - centres[s, 2]) / half_sizes[s, 2]
            norm = max(abs(x), abs(y), abs(z), one)
            factor = (two - one / norm) / norm
            x, y, z = (x * factor + two) * quarter, (y * factor + two) * quarter, (z * factor + two) * quarter
            within = min(x, y, z) > 0 and max(x, y, z) < one
            inside[i] = within
            positions[0, i] = x if within else 0
            positions[1, i] = y if within else 0
            positions[2, i] = z if within else 0


@numba.njit
def _encode(grid, work):
    """The encoding of every sorted sample."""
    table, offsets, levels = grid
    _, _, positions, _, encoded, _, segments, scratch = work
    features = table.shape[1]
    for level in range(len(levels)):
        for s in range(len(offsets)):
            start, first, last = offsets[s, level], segments[s], segments[s + 1]
            level_table = table[start : start + levels[level, 1]]
            encode_rows(positions, first, last, levels[level], level_table, encoded, level * features, scratch)


@numba.njit
def _infer(layers, work):
    """The network's first output at every sorted sample."""
    weights, biases, output_weights, output_bias = layers
    _, _, _, _, encoded, output, segments, _ = work
    for s in range(len(weights)):
        for i in range(segments[s], segments[s + 1], TOGETHER):  # beyond the last: rows of the next, which come later
            _infer_rows(  # pyright: ignore[reportCallIssue] - numba adds the first argument
                output[i:], encoded[i:], weights[s], biases[s], output_weights[s], output_bias[s]
            )


@intrinsic
def _infer_rows(typing_context, output, inputs, weights, biases, output_weights, output_bias):  # noqa: PLR0913, PLR0917
    """Fill output[:TOGETHER] with the network of inputs[:TOGETHER] (rows, width), LANES hidden values at a time."""

    def generate(context, builder, signature, arguments):
        arrays = [
            context.make_array(kind)(context, builder, value)
            for kind, value in zip(signature.args[:5], arguments[:5], strict=True)
        ]
        out, rows, first, bias, last = (array.data for array in arrays)
        width, hidden = cgutils.unpack_tuple(builder, arrays[2].shape, 2)
        zero = ir.Constant(VECTOR, [0.0] * LANES)
        totals = [cgutils.alloca_once_value(builder, zero) for _ in range(TOGETHER)]
        with cgutils.for_range_slice(builder, INT64(0), hidden, INT64(LANES)) as (h, _):
            start = _vector(builder, bias, h)
            sums = [cgutils.alloca_once(builder, VECTOR) for _ in range(TOGETHER)]
            for place in sums:
                builder.store(start, place)
            with cgutils.for_range(builder, width) as k_loop:
                k = k_loop.index
                weight = _vector(builder, first, builder.add(builder.mul(k, hidden), h))
                for number, place in enumerate(sums):
                    at = builder.add(builder.mul(INT64(number), width), k)
                    value = _spread(builder, builder.load(builder.gep(rows, [at])))
                    builder.store(_multiply_add(builder, value, weight, builder.load(place)), place)
            weight = _vector(builder, last, h)
            for place, total in zip(sums, totals, strict=True):
                value = builder.load(place)
                positive = builder.select(builder.fcmp_ordered("<", value, zero), zero, value)
                builder.store(_multiply_add(builder, positive, weight, builder.load(total)), total)
        kind = ir.FunctionType(FLOAT, [FLOAT, VECTOR])
        add_up = cgutils.get_or_insert_function(builder.module, kind, f"llvm.vector.reduce.fadd.v{LANES}f32")
        for number, total in enumerate(totals):
            result = builder.call(add_up, [arguments[5], builder.load(total)], fastmath=("reassoc",))
            builder.store(result, builder.gep(out, [INT64(number)]))
        return context.get_dummy_value()

    return types.void(output, inputs, weights, biases, output_weights, output_bias), generate


def _vector(builder, data, place):
    """LANES floats from data[place] on."""
    return builder.load(builder.bitcast(builder.gep(data, [place]), VECTOR.as_pointer()), align=4)


def _spread(builder, value):
    """A float in all lanes."""
    undefined = ir.Constant(VECTOR, ir.Undefined)
    lane = builder.insert_element(undefined, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(lane, undefined, ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES))


def _multiply_add(builder, first, second, total):
    product = builder.fmul(first, second, flags=("contract",))
    return builder.fadd(product, total, flags=("contract",))


@numba.njit(fastmath=FAST)
def _note(edges_m, followed, low, high, density_bias, fog, work, density, optical):  # noqa: PLR0913, PLR0917 - likewise
    """Write the densities of samples low..high of the followed rays, and add to their optical depths."""
    _, row, _, inside, _, output, _, _ = work
    n = 0
    for number, ray in enumerate(followed):
        for bin in range(low, high):
            i = row[n]
            n += 1
            value = math.exp(min(output[i] + density_bias, MOST)) if inside[i] else np.float32(0)
            value = np.float32(0) if value < fog else value
            density[ray, bin] = value
            optical[number] += value * (edges_m[ray, bin + 1] - edges_m[ray, bin])
