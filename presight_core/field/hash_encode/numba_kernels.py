"""The hash encoding on a CPU.

Points (3, N), one axis after the other, go through in blocks: the index arithmetic of a block becomes vector
instructions, and its eight corner rows are then fetched point by point. Levels are the outer loop, so that
one level's rows stay in the cache. Rows of four features move as one vector, through two small LLVM
intrinsics: twice as fast as four scalars.

`levels` rows are (resolution, row count, hashed or dense); see `GridLayout.levels`.
"""

import numba
import numpy as np
from llvmlite import ir
from numba import prange, types
from numba.extending import intrinsic

BLOCK = 64  # points; index and weight arrays of a block, 4 KiB, stay in the first-level cache
PREFETCHED_VALUES = 1 << 18  # 1 MiB: smaller tables stay in a second-level cache, where asking first costs time
PRIME_Y = np.uint32(2654435761)  # Instant-NGP, equation 4
PRIME_Z = np.uint32(805459861)
VECTOR = ir.VectorType(ir.FloatType(), 4)
INT64 = ir.IntType(64)


@numba.njit(parallel=True, fastmath=True, cache=True)
def encode(points, segments, table, offsets, levels, output, worker_count):  # noqa: PLR0913, PLR0917 - numba wants arrays
    """Fill output (N, levels * features). Workers take equal shares of the points (3, N)."""
    count = points.shape[1]
    share = (count + worker_count - 1) // worker_count
    for worker in prange(worker_count):
        scratch = corner_scratch()
        for level in range(len(levels)):
            for sub_field in range(len(offsets)):
                first = max(segments[sub_field], worker * share)
                last = min(segments[sub_field + 1], (worker + 1) * share)
                start = offsets[sub_field, level]
                level_table = table[start : start + levels[level, 1]]
                encode_rows(points, first, last, levels[level], level_table, output, level * table.shape[1], scratch)


@numba.njit(fastmath=True)
def encode_rows(points, first, last, level, level_table, output, column, scratch):  # noqa: PLR0913, PLR0917 - likewise
    """Fill a level's columns of output[first:last], for points that all belong to the sub-field of `level_table`."""
    features = level_table.shape[1]
    flat_table, flat_output = level_table.reshape(-1), output.reshape(-1)
    rows, weights, _, _ = scratch
    for low in range(first, last, BLOCK):
        count = min(BLOCK, last - low)
        _corners(points, low, count, level, scratch)
        _prefetch(flat_table, rows, features, count)
        if features == 4:
            for i in range(count):
                _gather_rows(  # pyright: ignore[reportCallIssue] - numba adds the first argument
                    flat_output, (low + i) * output.shape[1] + column, flat_table, rows, weights, i
                )
        else:
            _gather_scalars(output, low, count, column, level_table, scratch)


@numba.njit(parallel=True, fastmath=True, cache=True)
def table_gradient(points, segments, gradient, offsets, levels, result, worker_count):  # noqa: PLR0913, PLR0917 - likewise
    """Fill result (rows, features), of points (3, N). An item of work is a level of a sub-field, which owns its rows.

    So there are no atomics and no copies, and the sum is the same whatever the number of threads. A level
    is zeroed just before it is added to, while it is in the cache.
    """
    features = result.shape[1]
    flat_gradient = gradient.reshape(-1)
    level_count = len(levels)
    item_count = len(offsets) * level_count
    for worker in prange(worker_count):
        scratch = corner_scratch()
        rows, weights, _, _ = scratch
        for item in range(worker, item_count, worker_count):  # interleaved: fine levels cost more than coarse ones
            sub_field, level = item // level_count, item % level_count
            start = offsets[sub_field, level]
            level_table = result[start : start + levels[level, 1]]
            flat_table = level_table.reshape(-1)
            flat_table[:] = 0
            column = level * features
            last = segments[sub_field + 1]
            for low in range(segments[sub_field], last, BLOCK):
                count = min(BLOCK, last - low)
                _corners(points, low, count, levels[level], scratch)
                _prefetch(flat_table, rows, features, count)
                if features == 4:
                    for i in range(count):
                        _scatter_rows(  # pyright: ignore[reportCallIssue] - likewise
                            flat_table, flat_gradient, (low + i) * gradient.shape[1] + column, rows, weights, i
                        )
                else:
                    _scatter_scalars(level_table, gradient, low, count, column, scratch)


@numba.njit(inline="always")
def corner_scratch():
    """Corner rows (8, BLOCK), their weights (8, BLOCK), the cell (3, BLOCK) and the place in it (3, BLOCK)."""
    return (
        np.empty((8, BLOCK), np.uint32),
        np.empty((8, BLOCK), np.float32),
        np.empty((3, BLOCK), np.uint32),
        np.empty((3, BLOCK), np.float32),
    )


@numba.njit(inline="always", fastmath=True)
def _corners(points, low, count, level, scratch):
    """Fill rows and weights of the eight corners around each of points[:, low : low + count]."""
    _, _, cell, fraction = scratch
    resolution = np.float32(level[0])
    for axis in range(3):
        for i in range(count):
            scaled = points[axis, low + i] * resolution
            floor = np.int32(scaled)  # points are not negative
            cell[axis, i] = np.uint32(floor)
            fraction[axis, i] = scaled - np.float32(floor)
    if level[2]:
        _hashed_rows(count, np.uint32(level[1] - 1), scratch)
    else:
        _dense_rows(count, np.uint32(level[0] + 1), np.uint32(level[1] - 1), scratch)
    _trilinear_weights(count, scratch)


@numba.njit(inline="always", fastmath=True)
def _hashed_rows(count, mask, scratch):
    rows, _, cell, _ = scratch
    for i in range(count):
        x0 = cell[0, i]
        x1 = np.uint32(x0 + np.uint32(1))
        y0 = np.uint32(cell[1, i] * PRIME_Y)
        y1 = np.uint32(y0 + PRIME_Y)
        z0 = np.uint32(cell[2, i] * PRIME_Z)
        z1 = np.uint32(z0 + PRIME_Z)
        rows[0, i] = (x0 ^ y0 ^ z0) & mask
        rows[1, i] = (x1 ^ y0 ^ z0) & mask
        rows[2, i] = (x0 ^ y1 ^ z0) & mask
        rows[3, i] = (x1 ^ y1 ^ z0) & mask
        rows[4, i] = (x0 ^ y0 ^ z1) & mask
        rows[5, i] = (x1 ^ y0 ^ z1) & mask
        rows[6, i] = (x0 ^ y1 ^ z1) & mask
        rows[7, i] = (x1 ^ y1 ^ z1) & mask


@numba.njit(inline="always", fastmath=True)
def _dense_rows(count, edge, last, scratch):
    """Like `_hashed_rows` with a row for every corner; `min` keeps even a NaN point inside the table."""
    rows, _, cell, _ = scratch
    one = np.uint32(1)
    plane = np.uint32(edge * edge)
    for i in range(count):
        base = np.uint32(cell[0, i] + np.uint32(cell[1, i] * edge) + np.uint32(cell[2, i] * plane))
        rows[0, i] = min(base, last)
        rows[1, i] = min(np.uint32(base + one), last)
        rows[2, i] = min(np.uint32(base + edge), last)
        rows[3, i] = min(np.uint32(base + edge + one), last)
        rows[4, i] = min(np.uint32(base + plane), last)
        rows[5, i] = min(np.uint32(base + plane + one), last)
        rows[6, i] = min(np.uint32(base + plane + edge), last)
        rows[7, i] = min(np.uint32(base + plane + edge + one), last)


@numba.njit(inline="always", fastmath=True)
def _trilinear_weights(count, scratch):
    _, weights, _, fraction = scratch
    one = np.float32(1)
    for i in range(count):
        x1, y1, z1 = fraction[0, i], fraction[1, i], fraction[2, i]
        x0, y0, z0 = one - x1, one - y1, one - z1
        low_low, high_low, low_high, high_high = y0 * z0, y1 * z0, y0 * z1, y1 * z1
        weights[0, i] = x0 * low_low
        weights[1, i] = x1 * low_low
        weights[2, i] = x0 * high_low
        weights[3, i] = x1 * high_low
        weights[4, i] = x0 * low_high
        weights[5, i] = x1 * low_high
        weights[6, i] = x0 * high_high
        weights[7, i] = x1 * high_high


@numba.njit(inline="always", fastmath=True)
def _gather_scalars(output, low, count, column, level_table, scratch):
    rows, weights, _, _ = scratch
    for feature in range(level_table.shape[1]):
        for i in range(count):
            total = np.float32(0)
            for k in range(8):
                total += weights[k, i] * level_table[rows[k, i], feature]
            output[low + i, column + feature] = total


@numba.njit(inline="always", fastmath=True)
def _scatter_scalars(level_table, gradient, low, count, column, scratch):
    rows, weights, _, _ = scratch
    for i in range(count):
        for feature in range(level_table.shape[1]):
            upstream = gradient[low + i, column + feature]
            for k in range(8):
                level_table[rows[k, i], feature] += weights[k, i] * upstream


@numba.njit(inline="always")
def _prefetch(level_table, rows, features, count):
    """Ask for all rows of a block before the first is used: misses overlap, 15 % off a large table's time."""
    if len(level_table) >= PREFETCHED_VALUES:
        for k in range(8):
            for i in range(count):
                _prefetch_line(level_table, np.int64(rows[k, i]) * features)  # pyright: ignore[reportCallIssue] - likewise


@intrinsic
def _prefetch_line(typing_context, table, place):
    """Start loading the cache line of table[place]."""

    def generate(context, builder, signature, arguments):
        byte_pointer, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        function_type = ir.FunctionType(ir.VoidType(), [byte_pointer, number, number, number])
        prefetch = builder.module.declare_intrinsic("llvm.prefetch", [byte_pointer], function_type)
        line = builder.gep(_data(context, builder, signature, arguments, 0), [arguments[1]])
        # To read, into all cache levels, as data.
        options = [ir.Constant(number, option) for option in (0, 3, 1)]
        builder.call(prefetch, [builder.bitcast(line, byte_pointer), *options])
        return context.get_dummy_value()

    return types.void(table, types.int64), generate


@intrinsic
def _gather_rows(typing_context, output, place, table, rows, weights, i):  # noqa: PLR0913, PLR0917 - numba adds one
    """output[place : place + 4] = sum over k of weights[k, i] * (row rows[k, i] of the table)."""

    def generate(context, builder, signature, arguments):
        table_data, row_data, weight_data = (_data(context, builder, signature, arguments, n) for n in (2, 3, 4))
        total = None
        for k in range(8):
            row, weight = _corner(builder, (table_data, row_data, weight_data), arguments[5], k)
            term = builder.fmul(builder.load(row, align=4), weight, flags=("fast",))
            total = term if total is None else builder.fadd(total, term, flags=("fast",))
        target = builder.gep(_data(context, builder, signature, arguments, 0), [arguments[1]])
        builder.store(total, builder.bitcast(target, VECTOR.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(output, types.int64, table, rows, weights, types.int64), generate


@intrinsic
def _scatter_rows(typing_context, table, gradient, place, rows, weights, i):  # noqa: PLR0913, PLR0917 - likewise
    """(row rows[k, i] of the table) += weights[k, i] * gradient[place : place + 4], for each k."""

    def generate(context, builder, signature, arguments):
        table_data, row_data, weight_data = (_data(context, builder, signature, arguments, n) for n in (0, 3, 4))
        source = builder.gep(_data(context, builder, signature, arguments, 1), [arguments[2]])
        upstream = builder.load(builder.bitcast(source, VECTOR.as_pointer()), align=4)
        for k in range(8):
            row, weight = _corner(builder, (table_data, row_data, weight_data), arguments[5], k)
            term = builder.fmul(upstream, weight, flags=("fast",))
            builder.store(builder.fadd(builder.load(row, align=4), term, flags=("fast",)), row, align=4)
        return context.get_dummy_value()

    return types.void(table, gradient, types.int64, rows, weights, types.int64), generate


def _data(context, builder, signature, arguments, number):
    """Pointer to the first element of an array argument."""
    return context.make_array(signature.args[number])(context, builder, arguments[number]).data


def _corner(builder, pointers, i, k):
    """Pointer to the table row of corner k of point i, as a vector, and its weight in all four lanes."""
    table, rows, weights = pointers
    place = builder.add(i, ir.Constant(INT64, k * BLOCK))
    row = builder.zext(builder.load(builder.gep(rows, [place])), INT64)
    first = builder.gep(table, [builder.shl(row, ir.Constant(INT64, 2))])  # four features a row
    undefined = ir.Constant(VECTOR, ir.Undefined)
    weight = builder.load(builder.gep(weights, [place]))
    lane = builder.insert_element(undefined, weight, ir.Constant(ir.IntType(32), 0))
    lanes = ir.Constant(ir.VectorType(ir.IntType(32), 4), [0] * 4)
    return builder.bitcast(first, VECTOR.as_pointer()), builder.shuffle_vector(lane, undefined, lanes)
