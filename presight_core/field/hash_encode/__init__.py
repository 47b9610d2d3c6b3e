"""The multi-resolution hash encoding of Instant-NGP, as one torch operator for any number of sub-fields.

The main grid and the proposals of all sub-fields use the same operator. Its kernels are chosen by device:
numba on a CPU, Triton on a graphics card.
"""

import os
from collections.abc import Callable
from typing import Any

import numba
import torch
from torch import Tensor

from presight_core.field.hash_encode import numba_kernels, torch_reference
from presight_core.field.hash_encode.layout import GridLayout, grid_layout

__all__ = ["GridLayout", "grid_layout", "hash_encode"]


@torch.library.custom_op("presight::hash_encode", mutates_args=(), device_types="cpu")
def hash_encode(
    points: Tensor, segments: Tensor, table: Tensor, offsets: Tensor, levels: Tensor, copy: Tensor | None = None
) -> Tensor:
    """Encoded points (N, levels * features), level by level; differentiable in points and table.

    `points` (N, 3) float32 in [0, 1), sorted by sub-field; rows segments[s]..segments[s + 1] belong to
    sub-field s (`segments` is int64). `table` (rows, features) float32, `offsets` and `levels` come from a
    GridLayout. No half-cell shift: corner 0 of every level lies on the origin. With `copy`, the table rounded to
    another type, values are read from that, and returned in its type; the gradient is the table's all the same.
    """
    source = table if copy is None else copy.float()
    output = source.new_empty(len(points), len(levels) * table.shape[1])
    _run(numba_kernels.encode, points, segments, source, offsets, levels, output)
    return output if copy is None else output.to(copy.dtype)


@torch.library.custom_op("presight::hash_encode_table_gradient", mutates_args=(), device_types="cpu")
def table_gradient(
    points: Tensor, segments: Tensor, gradient: Tensor, offsets: Tensor, levels: Tensor, row_count: int
) -> Tensor:
    """Gradient (row_count, features) float32 of the table; `gradient` is that of the output."""
    result = torch.empty(row_count, gradient.shape[1] // len(levels), device=gradient.device)
    _run(numba_kernels.table_gradient, points, segments, gradient.float(), offsets, levels, result)
    return result


@torch.library.custom_op("presight::hash_encode_point_gradient", mutates_args=())
def point_gradient(
    points: Tensor, segments: Tensor, table: Tensor, offsets: Tensor, levels: Tensor, gradient: Tensor
) -> Tensor:
    """Gradient (N, 3) of the points; plain torch on a CPU, for training asks for the table's only."""
    return torch_reference.point_gradient(points, segments, table, offsets, levels, gradient)


def use_triton(device_type: str) -> None:
    """Let the Triton kernels take the tensors of a device: cuda, or cpu under Triton's interpreter."""

    def kernel(name: str) -> Callable[..., Tensor]:
        def run(*arguments: Any) -> Tensor:
            from presight_core.field.hash_encode import triton_kernels  # slow to import, and only there with a card

            return getattr(triton_kernels, name)(*arguments)

        return run

    hash_encode.register_kernel(device_type)(kernel("encode"))  # pyright: ignore[reportArgumentType] - "cpu" and "cuda"
    table_gradient.register_kernel(device_type)(kernel("table_gradient"))  # pyright: ignore[reportArgumentType]
    point_gradient.register_kernel(device_type)(kernel("point_gradient"))  # pyright: ignore[reportArgumentType]


use_triton("cuda")
if os.environ.get("TRITON_INTERPRET") == "1":
    use_triton("cpu")


@hash_encode.register_fake
def _(points, segments, table, offsets, levels, copy=None):
    return (table if copy is None else copy).new_empty(len(points), len(levels) * table.shape[1])


@table_gradient.register_fake
def _(points, segments, gradient, offsets, levels, row_count):
    return torch.empty(row_count, gradient.shape[1] // len(levels), device=gradient.device)


@point_gradient.register_fake
def _(points, segments, table, offsets, levels, gradient):
    return torch.empty_like(points)


def _remember(ctx, inputs, output) -> None:
    ctx.save_for_backward(*inputs[:5])


def _backward(ctx, gradient):
    points, segments, table, offsets, levels = ctx.saved_tensors
    gradient = gradient.contiguous()
    of_points, of_table = None, None
    if ctx.needs_input_grad[0]:
        of_points = point_gradient(points, segments, table, offsets, levels, gradient)
    if ctx.needs_input_grad[2]:
        of_table = table_gradient(points, segments, gradient, offsets, levels, len(table))
    return of_points, None, of_table, None, None, None


hash_encode.register_autograd(_backward, setup_context=_remember)


def _run(kernel: Callable[..., None], points: Tensor, *tensors: Tensor) -> None:
    """Run a kernel on the arrays of tensors, with as many workers as numba may use; the last tensor is filled.

    Points go to it axis by axis: eight of an axis fill a register, and a block's index arithmetic takes a third.
    """
    arrays = (tensor.detach().contiguous().numpy() for tensor in (points.t(), *tensors))
    kernel(*arrays, numba.get_num_threads())
