"""The training losses. Each returns one number; their weights are settings (paper, section 3.2)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

Edges = Float[Tensor, "rays edges"]
Weights = Float[Tensor, "rays bins"]


SLACK = 0.1  # of a ray's weight: a ray that something wrong is known of pulls ten times as hard as a right one at most


def feature_loss(rendered: Tensor, target: Tensor) -> Tensor:
    """Mean squared error of features; the target is clipped to [0, 1], the range of the feature space."""
    return functional.mse_loss(rendered, target.clamp(0, 1))


def sky_loss(
    accumulation: Float[Tensor, " rays"], is_sky: Bool[Tensor, " rays"], is_known: Bool[Tensor, " rays"] | None = None
) -> Tensor:
    """Binary cross-entropy: rays of the sky should end nowhere, all others somewhere.

    The mean over rays whose label `is_known`; 0 if none is. A product, because picking rays out would make shapes
    depend on values.
    """
    # The bound of half a float32 step below 1 keeps both logarithms finite.
    bounded = accumulation.clamp(1e-7, 1 - 1e-7)
    entropy = -torch.where(is_sky, 1 - bounded, bounded).log()
    return entropy.mean() if is_known is None else (entropy * is_known).sum() / is_known.sum().clamp_min(1)


def ground_loss(
    weights: Weights, middles_m: Float[Tensor, "rays bins"], start_m: Float[Tensor, " rays"]
) -> Float[Tensor, ""]:
    """Negative logarithm of the weight beyond `start_m`, mean over rays; rays that start at 0 cost nothing."""
    beyond = (weights * (middles_m > start_m[:, None])).sum(-1)
    return _missing(beyond, start_m > 0)


def stereo_loss(
    weights: Weights, edges_m: Edges, depth_m: Float[Tensor, " rays"], tolerance: float
) -> Float[Tensor, ""]:
    """Negative logarithm of the weight within a share of `depth_m`, mean over rays; rays of depth 0 cost nothing.

    Where bins are wider than that, the bin that holds the depth and its neighbour count.
    """
    middles_m, lengths_m = (edges_m[:, 1:] + edges_m[:, :-1]) / 2, edges_m.diff(dim=-1)
    is_near = (middles_m - depth_m[:, None]).abs() <= torch.maximum(tolerance * depth_m[:, None], lengths_m)
    return _missing((weights * is_near).sum(-1), depth_m > 0)


def _missing(weight: Float[Tensor, " rays"], is_known: Bool[Tensor, " rays"]) -> Float[Tensor, ""]:
    """Negative logarithm of weights that should be 1, mean over all rays; what is not known costs nothing."""
    return torch.where(is_known, -((weight + SLACK) / (1 + SLACK)).log(), 0).mean()


def distortion_loss(edges: Edges, weights: Weights) -> Tensor:
    """Mean over rays of `distortion`."""
    return distortion(edges, weights).mean()


def distortion(edges: Edges, weights: Weights) -> Float[Tensor, " rays"]:
    """How far a ray's weight is spread (mip-NeRF 360, equation 15), in s.

    sum_ij w_i w_j |m_i - m_j| needs no pairs: middles ascend, so prefix sums give it in O(samples).
    """
    middles = (edges[:, 1:] + edges[:, :-1]) / 2
    weighted = weights * middles
    weight_before = weights.cumsum(-1) - weights
    weighted_before = weighted.cumsum(-1) - weighted
    between = 2 * (weights * (middles * weight_before - weighted_before)).sum(-1)
    within = (weights.square() * edges.diff(dim=-1)).sum(-1) / 3
    return between + within


def interlevel_loss(edges: Edges, weights: Weights, proposal_edges: Edges, proposal_weights: Weights) -> Tensor:
    """Penalise a proposal that is lower than the field's histogram (mip-NeRF 360, equation 13).

    No gradient reaches the field's histogram.
    """
    edges, weights = edges.detach(), weights.detach()
    bound = _outer_bound(edges, proposal_edges.detach(), proposal_weights)
    return ((weights - bound).clamp_min(0).square() / (weights + 1e-7)).mean()


def blurred_interlevel_loss(
    edges: Edges, weights: Weights, proposal_edges: Edges, proposal_weights: Weights, pulse_width: float
) -> Tensor:
    """The anti-aliased form (Zip-NeRF, section 3): compare with the field's histogram blurred by a box.

    `pulse_width` is half the box's width in s. No gradient reaches the field's histogram.
    """
    reached = blurred_cumulative(edges.detach(), weights.detach(), proposal_edges.detach(), pulse_width)
    target = reached.diff(dim=-1).to(proposal_weights)
    return ((target - proposal_weights).clamp_min(0).square() / (proposal_weights + 1e-5)).mean()


def blurred_cumulative(edges: Edges, weights: Weights, at: Edges, half_width: float) -> Tensor:
    """The cumulative sum of a histogram blurred by a box, float64, at the places `at`.

    The blurred sum at x is the mean of the plain one over x - r .. x + r; the integral of the plain,
    piecewise-linear one is piecewise quadratic, so no blurred histogram has to be built. The difference
    of two integrals is divided by a small width: hence float64.
    """
    edges, weights, at = edges.double(), weights.double(), at.double()
    widths = edges.diff(dim=-1)
    reached = functional.pad(weights.cumsum(-1), (1, 0))
    integral = functional.pad(((reached[:, 1:] + reached[:, :-1]) / 2 * widths).cumsum(-1), (1, 0))
    # Beyond the last edge nothing is added; before the first the sum is zero.
    slope = functional.pad(weights / widths.clamp_min(1e-12), (0, 1))

    def integral_at(x: Tensor) -> Tensor:
        index = (torch.searchsorted(edges, x, right=True) - 1).clamp_min(0)
        beyond = (x - edges.gather(-1, index)).clamp_min(0)
        first_order = reached.gather(-1, index) * beyond
        return integral.gather(-1, index) + first_order + slope.gather(-1, index) / 2 * beyond.square()

    upper, lower = integral_at((at + half_width).contiguous()), integral_at((at - half_width).contiguous())
    return (upper - lower) / (2 * half_width)


def _outer_bound(edges: Edges, proposal_edges: Edges, proposal_weights: Weights) -> Weights:
    """Weight of all proposal bins that meet each bin of `edges`, be it at an upper edge only."""
    reached = functional.pad(proposal_weights.cumsum(-1), (1, 0))
    last = proposal_edges.shape[-1] - 1
    low = (torch.searchsorted(proposal_edges, edges[:, :-1].contiguous(), right=True) - 1).clamp(0, last - 1)
    high = torch.searchsorted(proposal_edges, edges[:, 1:].contiguous(), right=True).clamp(1, last)
    return reached.gather(-1, high) - reached.gather(-1, low)
