"""Multilayer perceptrons of which every sub-field has its own weights."""

import os
from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from presight_core.field.assignment import Assignment


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
        self, inputs: Float[Tensor, "points inputs"], assignment: Assignment
    ) -> Float[Tensor, "points outputs"]:
        """Outputs of each row, from the sub-field that it is assigned to."""
        if self._is_fused(inputs):
            from presight_core.field.triton_mlp import SubFieldLayers  # slow to import, and only there with a card

            layers = [layer for pair in zip(self.weights, self.biases, strict=True) for layer in pair]
            return SubFieldLayers.apply(inputs, assignment.segments, self.dtype, *layers)  # type: ignore[return-value]
        return self._one_by_one(inputs, assignment.bounds)

    def _is_fused(self, inputs: Tensor) -> bool:
        """Whether one kernel takes all sub-fields: on a card, in a half type; or under Triton's interpreter."""
        on_card = inputs.is_cuda and self.dtype != torch.float32
        return on_card or os.environ.get("TRITON_INTERPRET") == "1"

    def _one_by_one(self, inputs: Tensor, segments: Sequence[int]) -> Tensor:
        layers = [
            (weight.to(self.dtype).unbind(0), bias.to(self.dtype).unbind(0))
            for weight, bias in zip(self.weights, self.biases, strict=True)
        ]
        outputs = []
        for sub_field, (first, last) in enumerate(pairwise(segments)):
            values = inputs[first:last].to(self.dtype)
            for number, (weight, bias) in enumerate(layers):
                values = functional.relu_(values) if number else values
                values = functional.linear(values, weight[sub_field], bias[sub_field])
            outputs.append(values)
        return outputs[0] if len(outputs) == 1 else torch.cat(outputs)
