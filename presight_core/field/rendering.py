"""Volume rendering: densities along rays become weights, and weights become colours and depths."""

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

LARGEST_EXPONENT = 15.0  # Instant-NGP's bound of the gradient; 1 cm of such a density is opaque 30,000 times over


class TruncatedExponential(torch.autograd.Function):
    """exp(x), truncated at the upper end of its value; beyond -15..15 its gradient only leads back there.

    What lies behind a surface, or where nothing is, gets gradients that are next to nothing, and Adam makes whole steps
    of them: there x wanders, upwards beyond the 88 of which float32 knows the exponential, downwards by thousands, and
    takes the network's weights along (docs/decisions/031).
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.clamp(max=LARGEST_EXPONENT).exp()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        gradient = gradients[0] * x.clamp(-LARGEST_EXPONENT, LARGEST_EXPONENT).exp()
        return torch.where((x.abs() <= LARGEST_EXPONENT) | (x * gradient > 0), gradient, 0)


def truncated_exponential(x: Tensor) -> Tensor:
    """exp(x) with x clamped to at most 15; the gradient's exponent is clamped to -15..15, and leads no farther away."""
    return TruncatedExponential.apply(x)  # type: ignore[return-value]


class FadedGradient(torch.autograd.Function):
    """The identity, whose gradient is multiplied."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, scale: Tensor) -> Tensor:
        ctx.save_for_backward(scale)
        return x.view_as(x)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (scale,) = ctx.saved_tensors
        return gradients[0] * scale, None


def fade_gradient(x: Tensor, scale: Tensor) -> Tensor:
    """`x` itself; its gradient is multiplied by `scale`, which must broadcast to it."""
    return FadedGradient.apply(x, scale)  # type: ignore[return-value]


def share_of_rays(edges_m: Float[Tensor, "rays edges"], full_m: float) -> Float[Tensor, "rays samples"]:
    """How densely rays pass samples, against samples at `full_m`: the squared ratio of distances, 1 beyond.

    Near a camera a volume is met by far more rays than far from it, so it learns faster, and fog grows there. Gradients
    scaled by this undo it (Philip and Deschaintre, Floaters No More, 2023).
    """
    middles_m = (edges_m[:, 1:] + edges_m[:, :-1]) / 2
    return (middles_m / full_m).square().clamp_max(1)


def ray_weights(
    density: Float[Tensor, "rays samples"], lengths_m: Float[Tensor, "rays samples"]
) -> Float[Tensor, "rays samples"]:
    """Share of a ray that ends in each sample: T^i alpha^i of the paper; `density` is per metre."""
    optical = density * lengths_m
    before = functional.pad(optical.cumsum(-1)[..., :-1], (1, 0))  # a difference would lose what is small
    return (1 - torch.exp(-optical)) * torch.exp(-before)


def expected_depth(
    weights: Float[Tensor, "rays samples"], middles: Float[Tensor, "rays samples"]
) -> Float[Tensor, " rays"]:
    """Mean depth of where a ray ends; an empty ray gives its first middle."""
    depth = (weights * middles).sum(-1) / (weights.sum(-1) + 1e-10)
    return torch.minimum(torch.maximum(depth, middles[:, 0]), middles[:, -1])


def first_hit(weights: Float[Tensor, "rays samples"], threshold: float = 0.5) -> tuple[Tensor, Bool[Tensor, " rays"]]:
    """Index of the first sample at which the summed weight reaches `threshold`, and whether one does.

    Where none does the index is the last.
    """
    reached = weights.cumsum(-1) >= threshold
    found = reached[:, -1]
    index = (~reached).sum(-1).clamp_max(weights.shape[-1] - 1)
    return index, found


def first_hit_depth(
    weights: Float[Tensor, "rays samples"], edges_m: Float[Tensor, "rays edges"], threshold: float = 0.5
) -> tuple[Float[Tensor, " rays"], Bool[Tensor, " rays"]]:
    """Depth at which the summed weight passes `threshold`, taken to rise evenly inside a sample."""
    index, found = first_hit(weights, threshold)
    index = index[:, None]
    weight = weights.gather(-1, index)
    before = weights.cumsum(-1).gather(-1, index) - weight
    share = ((threshold - before) / weight.clamp_min(1e-6)).clamp(0, 1)
    start, end = edges_m.gather(-1, index), edges_m.gather(-1, index + 1)
    return (start + share * (end - start))[:, 0], found


def blend(weights: Float[Tensor, "rays samples"], values: Float[Tensor, "rays samples channels"]) -> Tensor:
    """Weighted sums (rays, channels) along each ray."""
    return torch.einsum("rs,rsc->rc", weights, values.to(weights))
