"""Sorting points by the sub-field they belong to, and putting results back in order."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True)
class Assignment:
    """A stable sort of points by sub-field. `order` is None where there is one sub-field only.

    Its tensors' shapes depend on the number of points alone, and nothing is read back from the device unless
    `bounds` are asked for.
    """

    segments: Tensor  # (sub-fields + 1,) int64: rows segments[s]..segments[s + 1] of the sorted points
    order: Tensor | None = None  # (N,) original row of each sorted row
    places: Tensor | None = None  # (N,) sorted row of each original row
    owner: Tensor | None = None  # (N,) sub-field of each sorted row

    @cached_property
    def bounds(self) -> list[int]:
        """The segments, for Python."""
        return self.segments.tolist()

    def sort(self, values: Tensor) -> Tensor:
        """Rows (N, ...) of the original order, sorted by sub-field."""
        return values if self.order is None else _Permutation.apply(values, self.order, self.places)  # type: ignore[return-value]

    def restore(self, values: Tensor) -> Tensor:
        """Rows (N, ...) sorted by sub-field, in the original order."""
        return values if self.order is None else _Permutation.apply(values, self.places, self.order)  # type: ignore[return-value]

    def spread(self, values: Tensor) -> Tensor:
        """A row for each sorted point, of one row (sub-fields, ...) for each sub-field."""
        return values if self.owner is None else values.index_select(0, self.owner)


def assign(points: Tensor, centroids: Tensor) -> Assignment:
    """Points (N, 3) to the nearest of the centroids (sub-fields, 3) (paper, section 3.2)."""
    count = len(centroids)
    if count == 1:
        return Assignment(torch.arange(2, device=points.device) * len(points))
    # |p - c|^2 less what all centroids share, halved.
    distances = (centroids.square().sum(-1) / 2) - points.detach() @ centroids.T
    small = torch.uint8 if count < 256 else torch.int32  # the sort moves these, digit by digit
    owner, order = torch.sort(distances.argmin(-1).to(small), stable=True)
    places = torch.empty_like(order).scatter_(0, order, torch.arange(len(order), device=order.device))
    owner = owner.int()
    segments = torch.searchsorted(owner, torch.arange(count + 1, dtype=torch.int32, device=points.device))
    return Assignment(segments, order, places, owner)


class _Permutation(torch.autograd.Function):
    """Rows in a new order. The gradient is a gather too, where indexing's own would add row by row."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, rows: Tensor, inverse: Tensor) -> Tensor:
        ctx.save_for_backward(inverse)
        return values[rows]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        (inverse,) = ctx.saved_tensors
        return gradients[0][inverse], None, None
