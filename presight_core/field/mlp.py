"""Multilayer perceptrons of which every sub-field has its own weights."""

import os
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from presight_core.field.assignment import Assignment

# Of 64 values, so that on a CPU a layer finds most of the one before it in the cache: a step takes 8 % less than with
# whole layers; half and twice as many do alike, a quarter is slower.
BLOCK_BYTES = 1 << 20
# In bfloat16 torch compiles machine code for every new number of rows on a CPU: blocks are filled up to a multiple.
HALF_ROWS = 512
# bfloat16's -inf read as int16: of negative numbers only those that are none, NaN, are greater.
MINUS_INFINITY = -128


class SubFieldMlp(nn.Module):
    """Linear layers with ReLU between them; inputs are sorted by sub-field.

    Calculates in `dtype`, and returns it; the parameters are float32.
    """

    dtype = torch.float32

    def __init__(self, sub_field_count: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for inputs, outputs in pairwise(widths):
            bound = inputs**-0.5  # torch.nn.Linear's own initialisation
            self.weights.append(torch.empty(sub_field_count, outputs, inputs).uniform_(-bound, bound))
            self.biases.append(torch.empty(sub_field_count, outputs).uniform_(-bound, bound))

    def forward(
        self, inputs: Float[Tensor, "points inputs"], assignment: Assignment, outputs: int | None = None
    ) -> Float[Tensor, "points outputs"]:
        """The first `outputs`, or all, of each row, from the sub-field that it is assigned to."""
        if self._is_fused(inputs):
            from presight_core.field.triton_mlp import SubFieldLayers  # slow to import, and only there with a card

            layers = [layer for pair in zip(self.weights, self.biases, strict=True) for layer in pair]
            result: Tensor = SubFieldLayers.apply(inputs, assignment.segments, self.dtype, *layers)  # type: ignore[assignment]
            return result[:, :outputs]
        return self.blockwise(inputs, assignment.bounds, outputs)

    def blockwise(self, inputs: Tensor, segments: Sequence[int], outputs: int | None = None) -> Tensor:
        """As `forward`, one sub-field after the other: rows segments[s]..segments[s + 1] go through sub-field s."""
        last = slice(outputs)
        parameters = (*self.weights[:-1], self.weights[-1][:, last], *self.biases[:-1], self.biases[-1][:, last])
        return _BlockwiseLayers.apply(inputs, segments, self.dtype, torch.is_grad_enabled(), *parameters)  # type: ignore[return-value]

    def _is_fused(self, inputs: Tensor) -> bool:
        """Whether one kernel takes all sub-fields: on a card, in a half type; or under Triton's interpreter."""
        on_card = inputs.is_cuda and self.dtype != torch.float32
        return on_card or os.environ.get("TRITON_INTERPRET") == "1"


class _BlockwiseLayers(torch.autograd.Function):
    """All layers of a block of rows, then the next block: on a CPU layers pass their values on in the cache."""

    @staticmethod
    def forward(
        ctx: Any, inputs: Tensor, segments: Sequence[int], dtype: torch.dtype, remember: bool, *parameters: Tensor
    ) -> Tensor:
        cast = [parameter.to(dtype) for parameter in parameters]
        weights, biases = cast[: len(cast) // 2], cast[len(cast) // 2 :]
        outputs = inputs.new_empty(len(inputs), weights[-1].shape[1], dtype=dtype)
        ctx.values, ctx.segments, ctx.inputs_type = [], segments, inputs.dtype
        ctx.save_for_backward(*weights)
        for sub_field, first, last in _blocks(segments, inputs.device, dtype):
            values = [_rows(inputs, first, last, dtype)]
            is_whole = len(values[0]) == last - first
            for number, (weight, bias) in enumerate(zip(weights, biases, strict=True), 1):
                into = outputs[first:last] if number == len(weights) and is_whole else None
                result = torch.addmm(bias[sub_field], values[-1], weight[sub_field].T, out=into)
                values.append(_relu_(result) if number < len(weights) else result)
            if not is_whole:
                outputs[first:last] = values[-1][: last - first]
            if remember:
                ctx.values.append(values[:-1])
        return outputs

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        weights = ctx.saved_tensors
        device, dtype = weights[0].device, weights[0].dtype
        total_type = torch.promote_types(dtype, torch.float32)  # sums of many rows are no half numbers
        of_weights = [torch.zeros_like(weight, dtype=total_type) for weight in weights]
        of_biases = [weight.new_zeros(weight.shape[:2], dtype=total_type) for weight in weights]
        of_inputs, width = None, weights[0].shape[2]
        first_weight = functional.pad(weights[0], (0, -width % 8))  # products of 48 columns take half of those of 47
        if ctx.needs_input_grad[0]:
            of_inputs = gradients[0].new_empty(len(gradients[0]), width, dtype=ctx.inputs_type)
        for (sub_field, first, last), values in zip(_blocks(ctx.segments, device, dtype), ctx.values, strict=True):
            gradient = _rows(gradients[0], first, last, dtype)
            for number in reversed(range(len(weights))):
                _add_product(of_weights[number][sub_field], gradient, values[number])
                of_biases[number][sub_field] += gradient.sum(0)
                if number:
                    gradient = gradient @ weights[number][sub_field]
                    _zero_where_cut(gradient, values[number])
                elif of_inputs is not None:
                    of_inputs[first:last] = (gradient @ first_weight[sub_field])[: last - first, :width]
        return of_inputs, None, None, None, *of_weights, *of_biases


def _blocks(segments: Sequence[int], device: torch.device, dtype: torch.dtype) -> Iterator[tuple[int, int, int]]:
    """Sub-field, first row and end of each block; elsewhere than on a CPU a sub-field is one block."""
    rows = BLOCK_BYTES // (64 * dtype.itemsize) if device.type == "cpu" else max(segments[-1], 1)
    for sub_field, (start, end) in enumerate(pairwise(segments)):
        for first in range(start, end, rows):
            yield sub_field, first, min(first + rows, end)


def _rows(values: Tensor, first: int, last: int, dtype: torch.dtype) -> Tensor:
    """Rows first..last in a type; on a CPU in a half type, rows of zeros follow up to a multiple of HALF_ROWS."""
    lacking = first - last if dtype.itemsize < 4 and values.device.type == "cpu" else 0
    lacking %= HALF_ROWS
    if not lacking:
        return values[first:last].to(dtype)
    padded = values.new_empty(last - first + lacking, values.shape[1], dtype=dtype)
    padded[: last - first] = values[first:last]
    padded[last - first :] = 0
    return padded


def _relu_(values: Tensor) -> Tensor:
    """ReLU in place. On a CPU bfloat16 goes through float32 and back, which takes four times as long as integers do."""
    if not _counts_as_integers(values):
        return values.relu_()
    torch.threshold_(values.view(torch.int16), MINUS_INFINITY, 0)
    return values


def _zero_where_cut(gradient: Tensor, values: Tensor) -> None:
    """The gradient of ReLU in place, where it gave these values."""
    if _counts_as_integers(values):
        gradient, values = gradient.view(torch.int16), values.view(torch.int16)
    torch.ops.aten.threshold_backward(gradient, values, 0, grad_input=gradient)


def _counts_as_integers(values: Tensor) -> bool:
    return values.dtype == torch.bfloat16 and values.device.type == "cpu"


def _add_product(total: Tensor, gradient: Tensor, values: Tensor) -> None:
    """Add gradient.T @ values, which may be of a narrower type.

    With the narrower operand first: MKL takes seven times as long for eight inputs the other way.
    """
    if values.shape[1] < gradient.shape[1]:
        total += (values.T @ gradient).T
    else:
        total += gradient.T @ values
