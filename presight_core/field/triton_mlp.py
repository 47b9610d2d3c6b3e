"""The sub-fields' networks on a graphics card: all layers of a network in one kernel, there and back.

A program takes a block of rows of one sub-field through all layers, and hidden values never leave it; the way
back calculates them anew. Blocks are found from the segments in device memory, so that shapes never change.
"""
# pyright: reportArgumentType=false, reportGeneralTypeIssues=false, reportCallIssue=false
# Kernels are a language of their own: arguments become constants.

from collections.abc import Sequence
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

BLOCK = 64  # rows; a warp group's matrix instructions take 64
BLOCKS_BACK = 16  # of a program on the way back: it adds up the weights' gradients before it writes them
WARPS, WARPS_BACK = 4, 8  # more on the way back: three matrices of sums stay in registers
STAGES_BACK = 2  # of loads ahead of their use; three would not fit into shared memory
LEAST = 16  # narrower matrices than this are padded


class SubFieldLayers(torch.autograd.Function):
    """Two or three linear layers with ReLU between them; every sub-field has its own.

    Takes inputs (N, K) sorted by sub-field, segments (sub-fields + 1,), the type to calculate in, and weights
    (sub-fields, out, in) and biases (sub-fields, out) of the layers by turns, float32, as their gradients are. All
    hidden layers are of one width. The type should be a half one: float32 matrices do not fit into registers.
    """

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, segments: Tensor, dtype: torch.dtype, *layers: Tensor) -> Tensor:
        inputs = inputs.contiguous()
        layers = tuple(layer.to(dtype) if layer.ndim == 3 else layer for layer in layers)
        ctx.save_for_backward(inputs, segments, *layers)
        output = inputs.new_empty(len(inputs), layers[-1].shape[1], dtype=dtype)
        with torch.cuda.device_of(inputs):  # Triton launches on the present device
            _forward[(_block_count(inputs, segments, BLOCK),)](
                inputs, segments, *_three(layers), output, **_constants(layers, segments), num_warps=WARPS
            )
        return output

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        inputs, segments, *layers = ctx.saved_tensors
        gradient = gradients[0].contiguous()
        of_inputs = torch.empty_like(inputs)
        of_layers = [torch.zeros_like(layer, dtype=torch.float32) for layer in layers]
        with torch.cuda.device_of(inputs):  # Triton launches on the present device
            _backward[(_block_count(inputs, segments, BLOCK * BLOCKS_BACK),)](
                inputs, segments, *_three(layers), gradient, of_inputs, *_three(of_layers),
                **_constants(layers, segments), blocks=BLOCKS_BACK, num_warps=WARPS_BACK, num_stages=STAGES_BACK,
            )  # fmt: skip
        return of_inputs, None, None, *of_layers


def _block_count(inputs: Tensor, segments: Tensor, rows: int) -> int:
    """At least as many blocks as there are: each sub-field's last one may be cut short."""
    return triton.cdiv(len(inputs), rows) + len(segments) - 1


def _three(layers: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """First, second and last layer; of two layers the first stands in for the second, and is not used as such."""
    assert len(layers) in {4, 6}, "networks have two or three layers"
    return (*layers[:2], *layers[-4:]) if len(layers) == 6 else (*layers[:2], *layers[:2], *layers[-2:])


def _constants(layers: Sequence[Tensor], segments: Tensor) -> dict[str, int]:
    widths = {"inputs": layers[0].shape[2], "hidden": layers[0].shape[1], "output": layers[-1].shape[1]}
    return {
        "sub_field_count": len(segments) - 1,
        **{f"{name}_width": width for name, width in widths.items()},
        **{f"{name}_side": max(LEAST, triton.next_power_of_2(width)) for name, width in widths.items()},
        "has_middle": len(layers) == 6,
        "block": BLOCK,
        "enable_fp_fusion": True,
    }


@triton.jit
def _forward(
    inputs, segments, weight_1, bias_1, weight_2, bias_2, weight_3, bias_3, output,
    sub_field_count: tl.constexpr, inputs_width: tl.constexpr, hidden_width: tl.constexpr,
    output_width: tl.constexpr, inputs_side: tl.constexpr, hidden_side: tl.constexpr, output_side: tl.constexpr,
    has_middle: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    sub_field, first, end = _rows_of(segments, tl.program_id(0), sub_field_count, block)
    if first < end:
        dtype: tl.constexpr = output.dtype.element_ty
        values = _load(inputs, first, end, block, inputs_width, inputs_side).to(dtype)
        values = _layer(values, weight_1, bias_1, sub_field, hidden_width, inputs_width, hidden_side, inputs_side)
        values = tl.maximum(values, 0.0).to(dtype)
        if has_middle:
            values = _layer(values, weight_2, bias_2, sub_field, hidden_width, hidden_width, hidden_side, hidden_side)
            values = tl.maximum(values, 0.0).to(dtype)
        values = _layer(values, weight_3, bias_3, sub_field, output_width, hidden_width, output_side, hidden_side)
        _store(output, values, first, end, block, output_width, output_side)


@triton.jit
def _backward(
    inputs, segments, weight_1, bias_1, weight_2, bias_2, weight_3, bias_3, gradient,
    of_inputs, of_weight_1, of_bias_1, of_weight_2, of_bias_2, of_weight_3, of_bias_3,
    sub_field_count: tl.constexpr, inputs_width: tl.constexpr, hidden_width: tl.constexpr,
    output_width: tl.constexpr, inputs_side: tl.constexpr, hidden_side: tl.constexpr, output_side: tl.constexpr,
    has_middle: tl.constexpr, block: tl.constexpr, blocks: tl.constexpr,
):  # fmt: skip
    sub_field, first, end = _rows_of(segments, tl.program_id(0), sub_field_count, block * blocks)
    if first < end:
        dtype: tl.constexpr = gradient.dtype.element_ty
        sum_1 = tl.zeros((hidden_side, inputs_side), tl.float32)
        sum_2 = tl.zeros((hidden_side, hidden_side), tl.float32)
        sum_3 = tl.zeros((output_side, hidden_side), tl.float32)
        shift_1 = tl.zeros((hidden_side,), tl.float32)
        shift_2 = tl.zeros((hidden_side,), tl.float32)
        shift_3 = tl.zeros((output_side,), tl.float32)
        for start in range(first, end, block):
            values = _load(inputs, start, end, block, inputs_width, inputs_side).to(dtype)
            hidden = _layer(values, weight_1, bias_1, sub_field, hidden_width, inputs_width, hidden_side, inputs_side)
            hidden_1 = tl.maximum(hidden, 0.0).to(dtype)
            hidden_2 = hidden_1
            if has_middle:
                hidden = _layer(
                    hidden_1, weight_2, bias_2, sub_field, hidden_width, hidden_width, hidden_side, hidden_side
                )
                hidden_2 = tl.maximum(hidden, 0.0).to(dtype)
            upstream = _load(gradient, start, end, block, output_width, output_side)
            sum_3 += tl.dot(tl.trans(upstream), hidden_2, input_precision="ieee")
            shift_3 += tl.sum(upstream.to(tl.float32), 0)
            upstream = _back(upstream, weight_3, sub_field, output_width, hidden_width, output_side, hidden_side)
            upstream = tl.where(hidden_2 > 0, upstream, 0.0).to(dtype)
            if has_middle:
                sum_2 += tl.dot(tl.trans(upstream), hidden_1, input_precision="ieee")
                shift_2 += tl.sum(upstream.to(tl.float32), 0)
                upstream = _back(upstream, weight_2, sub_field, hidden_width, hidden_width, hidden_side, hidden_side)
                upstream = tl.where(hidden_1 > 0, upstream, 0.0).to(dtype)
            sum_1 += tl.dot(tl.trans(upstream), values, input_precision="ieee")
            shift_1 += tl.sum(upstream.to(tl.float32), 0)
            upstream = _back(upstream, weight_1, sub_field, hidden_width, inputs_width, hidden_side, inputs_side)
            _store(of_inputs, upstream, start, end, block, inputs_width, inputs_side)
        _add(of_weight_1, of_bias_1, sum_1, shift_1, sub_field, hidden_width, inputs_width, hidden_side, inputs_side)
        if has_middle:
            _add(
                of_weight_2, of_bias_2, sum_2, shift_2, sub_field, hidden_width, hidden_width, hidden_side, hidden_side
            )
        _add(of_weight_3, of_bias_3, sum_3, shift_3, sub_field, output_width, hidden_width, output_side, hidden_side)


@triton.jit
def _rows_of(segments, program, sub_field_count: tl.constexpr, rows: tl.constexpr):
    """The sub-field of a program, and the first row and the end of its share; no row where none is left."""
    sub_field = 0
    first = tl.load(segments) * 0
    end = first
    before = first  # programs of the sub-fields so far
    for number in range(sub_field_count):
        start, stop = tl.load(segments + number), tl.load(segments + number + 1)
        programs = (stop - start + rows - 1) // rows
        if (program >= before) & (program < before + programs):
            sub_field = number
            first = start + (program - before) * rows
            end = tl.minimum(first + rows, stop)
        before += programs
    return sub_field, first, end


@triton.jit
def _load(source, start, end, block: tl.constexpr, width: tl.constexpr, side: tl.constexpr):
    """Rows start..end (block, side) of an array of `width` columns, with zeros beyond."""
    row = start + tl.arange(0, block)[:, None]
    column = tl.arange(0, side)[None, :]
    return tl.load(source + row * width + column, mask=(row < end) & (column < width), other=0.0)


@triton.jit
def _store(target, values, start, end, block: tl.constexpr, width: tl.constexpr, side: tl.constexpr):
    row = start + tl.arange(0, block)[:, None]
    column = tl.arange(0, side)[None, :]
    tl.store(target + row * width + column, values.to(target.dtype.element_ty), mask=(row < end) & (column < width))


@triton.jit
def _layer(
    values, weight, bias, sub_field, outputs: tl.constexpr, inputs: tl.constexpr,
    output_side: tl.constexpr, input_side: tl.constexpr,
):  # fmt: skip
    """values @ weight.T + bias, float32."""
    row = tl.arange(0, output_side)
    column = tl.arange(0, input_side)
    place = sub_field * outputs * inputs + row[None, :] * inputs + column[:, None]
    matrix = tl.load(weight + place, mask=(row < outputs)[None, :] & (column < inputs)[:, None], other=0.0)
    shift = tl.load(bias + sub_field * outputs + row, mask=row < outputs, other=0.0)
    return tl.dot(values, matrix, input_precision="ieee") + shift[None, :]


@triton.jit
def _back(
    upstream, weight, sub_field, outputs: tl.constexpr, inputs: tl.constexpr,
    output_side: tl.constexpr, input_side: tl.constexpr,
):  # fmt: skip
    """upstream @ weight, float32."""
    row = tl.arange(0, output_side)[:, None]
    column = tl.arange(0, input_side)[None, :]
    place = sub_field * outputs * inputs + row * inputs + column
    matrix = tl.load(weight + place, mask=(row < outputs) & (column < inputs), other=0.0)
    return tl.dot(upstream, matrix, input_precision="ieee")


@triton.jit
def _add(
    weight, bias, matrix, shift, sub_field, outputs: tl.constexpr, inputs: tl.constexpr,
    output_side: tl.constexpr, input_side: tl.constexpr,
):  # fmt: skip
    """Add a program's sums to those of its sub-field."""
    row = tl.arange(0, output_side)
    column = tl.arange(0, input_side)
    place = sub_field * outputs * inputs + row[:, None] * inputs + column[None, :]
    valid = (row < outputs)[:, None] & (column < inputs)[None, :]
    tl.atomic_add(weight + place, matrix, mask=valid, sem="relaxed")
    tl.atomic_add(bias + sub_field * outputs + row, shift, mask=row < outputs, sem="relaxed")
