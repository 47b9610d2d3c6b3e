"""The hash encoding on a graphics card.

A program takes a block of points through a few levels, four features of a row at a time: loads of a row are
one 16-byte access, and so is each addition to the gradient. Points find their sub-field by comparing their
number with the segments in device memory, so that one call serves all sub-fields and shapes never change.

`levels` rows are (resolution, row count, hashed or dense); see `GridLayout.levels`. The gradient of the table
is a sum of atomic additions: its last bits differ from run to run.
"""
# pyright: reportArgumentType=false, reportGeneralTypeIssues=false
# Kernels are a language of their own: arguments become constants, and loops are unrolled.

from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

PRIME_Y = tl.constexpr(2654435761)  # Instant-NGP, equation 4
PRIME_Z = tl.constexpr(805459861)


@dataclass(frozen=True)
class Launch:
    """How the work of a kernel is cut up."""

    points: int = 256  # of a program
    levels: int = 2  # of a program, one after the other; neighbours in the output row then meet in the cache
    warps: int = 4

    def grid(self, point_count: int, level_count: int) -> tuple[int, int]:
        """Programs along points and levels. All points of a level come before the next: its rows stay in the cache."""
        return max(1, triton.cdiv(point_count, self.points)), triton.cdiv(level_count, self.levels)


def default_launch(features: int) -> Launch:
    """Rows of one feature are so small that all levels of a sub-field fit into the cache together."""
    return Launch() if features > 1 else Launch(levels=8)


def encode(
    points: Tensor,
    segments: Tensor,
    table: Tensor,
    offsets: Tensor,
    levels: Tensor,
    copy: Tensor | None = None,
    launch: Launch | None = None,
) -> Tensor:
    """Encoded points (N, levels * features); see `hash_encode`."""
    source, features = table if copy is None else copy, table.shape[1]
    launch = launch or default_launch(features)
    output = source.new_empty(len(points), len(levels) * features)
    with torch.cuda.device_of(points):  # Triton launches on the present device
        _encode[launch.grid(len(points), len(levels))](
            points.contiguous(), segments, source, offsets, levels, output, len(points),
            **_constants(offsets, levels, features, launch),
        )  # fmt: skip
    return output


def table_gradient(
    points: Tensor,
    segments: Tensor,
    gradient: Tensor,
    offsets: Tensor,
    levels: Tensor,
    row_count: int,
    launch: Launch | None = None,
) -> Tensor:
    """Gradient (row_count, features) float32 of the table for the gradient (N, levels * features) of the output."""
    features = gradient.shape[1] // len(levels)
    launch = launch or default_launch(features)
    result = torch.zeros(row_count, features, dtype=torch.float32, device=gradient.device)
    with torch.cuda.device_of(points):  # Triton launches on the present device
        _table_gradient[launch.grid(len(points), len(levels))](
            points.contiguous(), segments, gradient.contiguous(), offsets, levels, result, len(points),
            **_constants(offsets, levels, features, launch),
        )  # fmt: skip
    return result


def point_gradient(
    points: Tensor,
    segments: Tensor,
    table: Tensor,
    offsets: Tensor,
    levels: Tensor,
    gradient: Tensor,
    launch: Launch | None = None,
) -> Tensor:
    """Gradient (N, 3) of the points for the gradient (N, levels * features) of the output."""
    features = table.shape[1]
    launch = launch or Launch(points=128, levels=len(levels))  # one program adds up all levels of its points
    result = torch.empty_like(points, memory_format=torch.contiguous_format)
    with torch.cuda.device_of(points):  # Triton launches on the present device
        _point_gradient[launch.grid(len(points), launch.levels)](
            points.contiguous(), segments, table, offsets, levels, gradient.contiguous(), result, len(points),
            **_constants(offsets, levels, features, launch),
        )  # fmt: skip
    return result


def _constants(offsets: Tensor, levels: Tensor, features: int, launch: Launch) -> dict[str, int]:
    return {
        "sub_field_count": len(offsets),
        "level_count": len(levels),
        "features": features,
        "row": triton.next_power_of_2(features),  # a block's sides are powers of two
        "block": launch.points,
        "level_block": launch.levels,
        "num_warps": launch.warps,
        "enable_fp_fusion": True,  # one rounding for a product and a sum; Triton 3.10 will no longer do so unasked
    }


@triton.jit
def _encode(
    points, segments, table, offsets, levels, output, point_count,
    sub_field_count: tl.constexpr, level_count: tl.constexpr, features: tl.constexpr, row: tl.constexpr,
    block: tl.constexpr, level_block: tl.constexpr,
):  # fmt: skip
    number = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    valid = number < point_count
    x, y, z = _position(points, number, valid)
    sub_field = _sub_field(segments, number, sub_field_count)
    column = tl.arange(0, row)[None, :]
    valid_row = valid[:, None] & (column < features)
    for step in range(level_block):
        level = tl.program_id(1) * level_block + step
        if level < level_count:
            resolution, edge, last, hashed = _level(levels, level)
            start = tl.load(offsets + sub_field * level_count + level, mask=valid, other=0)
            cell_x, cell_y, cell_z, in_x, in_y, in_z = _cell(x, y, z, resolution)
            total = tl.zeros((block, row), tl.float32)
            for corner in tl.static_range(8):
                weight = _weight(in_x, in_y, in_z, corner)
                local = _corner_row(cell_x, cell_y, cell_z, corner, edge, last, hashed)
                place = (start + local.to(tl.int64))[:, None] * features + column
                total += weight[:, None] * tl.load(table + place, mask=valid_row, other=0.0).to(tl.float32)
            target = output + number[:, None] * (level_count * features) + level * features + column
            tl.store(target, total.to(output.dtype.element_ty), mask=valid_row)


@triton.jit
def _table_gradient(
    points, segments, gradient, offsets, levels, result, point_count,
    sub_field_count: tl.constexpr, level_count: tl.constexpr, features: tl.constexpr, row: tl.constexpr,
    block: tl.constexpr, level_block: tl.constexpr,
):  # fmt: skip
    number = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    valid = number < point_count
    x, y, z = _position(points, number, valid)
    sub_field = _sub_field(segments, number, sub_field_count)
    column = tl.arange(0, row)[None, :]
    valid_row = valid[:, None] & (column < features)
    for step in range(level_block):
        level = tl.program_id(1) * level_block + step
        if level < level_count:
            resolution, edge, last, hashed = _level(levels, level)
            start = tl.load(offsets + sub_field * level_count + level, mask=valid, other=0)
            cell_x, cell_y, cell_z, in_x, in_y, in_z = _cell(x, y, z, resolution)
            source = gradient + number[:, None] * (level_count * features) + level * features + column
            upstream = tl.load(source, mask=valid_row, other=0.0).to(tl.float32)
            for corner in tl.static_range(8):
                weight = _weight(in_x, in_y, in_z, corner)
                local = _corner_row(cell_x, cell_y, cell_z, corner, edge, last, hashed)
                place = (start + local.to(tl.int64))[:, None] * features + column
                tl.atomic_add(result + place, weight[:, None] * upstream, mask=valid_row, sem="relaxed")


@triton.jit
def _point_gradient(
    points, segments, table, offsets, levels, gradient, result, point_count,
    sub_field_count: tl.constexpr, level_count: tl.constexpr, features: tl.constexpr, row: tl.constexpr,
    block: tl.constexpr, level_block: tl.constexpr,
):  # fmt: skip
    number = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    valid = number < point_count
    x, y, z = _position(points, number, valid)
    sub_field = _sub_field(segments, number, sub_field_count)
    column = tl.arange(0, row)[None, :]
    valid_row = valid[:, None] & (column < features)
    along_x = tl.zeros((block,), tl.float32)
    along_y = tl.zeros((block,), tl.float32)
    along_z = tl.zeros((block,), tl.float32)
    for level in range(level_block):
        resolution, edge, last, hashed = _level(levels, level)
        start = tl.load(offsets + sub_field * level_count + level, mask=valid, other=0)
        cell_x, cell_y, cell_z, in_x, in_y, in_z = _cell(x, y, z, resolution)
        source = gradient + number[:, None] * (level_count * features) + level * features + column
        upstream = tl.load(source, mask=valid_row, other=0.0).to(tl.float32)
        for corner in tl.static_range(8):
            local = _corner_row(cell_x, cell_y, cell_z, corner, edge, last, hashed)
            place = (start + local.to(tl.int64))[:, None] * features + column
            values = tl.load(table + place, mask=valid_row, other=0.0).to(tl.float32)
            change = tl.sum(values * upstream, 1) * resolution
            weight_x = _share(in_x, corner & 1)
            weight_y = _share(in_y, corner >> 1 & 1)
            weight_z = _share(in_z, corner >> 2)
            along_x += change * weight_y * weight_z * ((corner & 1) * 2 - 1)
            along_y += change * weight_x * weight_z * ((corner >> 1 & 1) * 2 - 1)
            along_z += change * weight_x * weight_y * ((corner >> 2) * 2 - 1)
    tl.store(result + number * 3, along_x, mask=valid)
    tl.store(result + number * 3 + 1, along_y, mask=valid)
    tl.store(result + number * 3 + 2, along_z, mask=valid)


@triton.jit
def _position(points, number, valid):
    x = tl.load(points + number * 3, mask=valid, other=0.0)
    y = tl.load(points + number * 3 + 1, mask=valid, other=0.0)
    z = tl.load(points + number * 3 + 2, mask=valid, other=0.0)
    return x, y, z


@triton.jit
def _sub_field(segments, number, sub_field_count: tl.constexpr):
    """How many sub-fields end at or before each point."""
    ended = tl.zeros_like(number)
    for sub_field in range(1, sub_field_count):
        ended += (number >= tl.load(segments + sub_field)).to(tl.int64)
    return ended


@triton.jit
def _level(levels, level):
    """Resolution, rows along an edge, last row, and whether the level is hashed."""
    resolution = tl.load(levels + level * 3)
    last = (tl.load(levels + level * 3 + 1) - 1).to(tl.uint32)
    return resolution.to(tl.float32), (resolution + 1).to(tl.uint32), last, tl.load(levels + level * 3 + 2) != 0


@triton.jit
def _cell(x, y, z, resolution):
    """The cell that holds each point, and the place in it."""
    x, y, z = x * resolution, y * resolution, z * resolution
    low_x, low_y, low_z = x.to(tl.int32), y.to(tl.int32), z.to(tl.int32)  # points are not negative
    in_x, in_y, in_z = x - low_x.to(tl.float32), y - low_y.to(tl.float32), z - low_z.to(tl.float32)
    return low_x.to(tl.uint32), low_y.to(tl.uint32), low_z.to(tl.uint32), in_x, in_y, in_z


@triton.jit
def _corner_row(cell_x, cell_y, cell_z, corner: tl.constexpr, edge, last, hashed):
    """Row of a corner in its level; a mask or a minimum keeps even a NaN point inside the table."""
    x = cell_x + (corner & 1)
    y = cell_y + (corner >> 1 & 1)
    z = cell_z + (corner >> 2)
    if hashed:
        local = (x ^ (y * PRIME_Y) ^ (z * PRIME_Z)) & last
    else:
        local = tl.minimum(x + (y + z * edge) * edge, last)
    return local


@triton.jit
def _weight(in_x, in_y, in_z, corner: tl.constexpr):
    """The trilinear weight of a corner."""
    return _share(in_x, corner & 1) * _share(in_y, corner >> 1 & 1) * _share(in_z, corner >> 2)


@triton.jit
def _share(place, upper: tl.constexpr):
    if upper:
        share = place
    else:
        share = 1 - place
    return share
