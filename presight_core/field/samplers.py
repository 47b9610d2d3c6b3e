"""Where samples lie along a ray.

Places along a ray have two scales: metres from the origin, and `s`, which runs from 0 at the near plane to
1 at the far plane, linear in metres at first and in disparity beyond.
"""

from dataclasses import dataclass

import numba
import torch
from jaxtyping import Float
from numba import prange
from torch import Tensor

LEAST_WEIGHT = 1e-5  # in all, on a ray: what lacks is spread evenly, so that an empty ray without padding is uniform


@dataclass(frozen=True)
class Spacing:
    """The map between s and metres: half of the spacing lies before `linear_m`, half between it and infinity."""

    near_m: float | Tensor
    far_m: float | Tensor
    linear_m: float

    def metres(self, s: Tensor) -> Tensor:
        """Metres along the ray at s."""
        near, far = self._spaced(self.near_m, s), self._spaced(self.far_m, s)
        return metres_from_spacing(s * far + (1 - s) * near, self.linear_m)

    def _spaced(self, metres: float | Tensor, like: Tensor) -> Tensor:
        if not isinstance(metres, Tensor):  # written by the device itself: a copy would have to wait for the host
            metres = torch.full((), metres, dtype=like.dtype, device=like.device)
        return spacing_from_metres(metres.to(like), self.linear_m)


def far_above_floor(
    directions: Float[Tensor, "rays 3"], far_m: float, floor_m: float, slope: float
) -> Float[Tensor, "rays 1"]:
    """Metres along each ray to the floor, at most `far_m`.

    The floor is a cone: `floor_m` below the ray's origin and falling by `slope` per horizontal metre. Asphalt has
    so little texture that a field can explain it from any distance; a ray that ends here cannot let it sink.
    """
    descent = -directions[:, 2:] - slope * directions[:, :2].norm(dim=-1, keepdim=True)
    return torch.where(descent > floor_m / far_m, floor_m / descent.clamp_min(floor_m / far_m), far_m)


def spacing_from_metres(metres: Tensor, linear_m: float) -> Tensor:
    """The spacing function: linear up to `linear_m` (where it is 1/2), then in disparity, 1 at infinity."""
    return torch.where(metres < linear_m, metres / (2 * linear_m), 1 - linear_m / (2 * metres))


def metres_from_spacing(spaced: Tensor, linear_m: float) -> Tensor:
    """The inverse of `spacing_from_metres`."""
    return torch.where(spaced < 0.5, 2 * linear_m * spaced, linear_m / (2 - 2 * spaced))


def uniform_edges(
    ray_count: int, sample_count: int, jitter: Float[Tensor, "rays 1"] | None, like: Tensor
) -> Float[Tensor, "rays edges"]:
    """Edges s of equal bins; with `jitter` (in [0, 1)) each edge moves by up to half a bin, all alike on a ray."""
    edges = torch.linspace(0, 1, sample_count + 1, dtype=like.dtype, device=like.device)
    if jitter is None:
        return edges.expand(ray_count, -1)
    middles = (edges[1:] + edges[:-1]) / 2
    lower, upper = torch.cat([edges[:1], middles]), torch.cat([middles, edges[-1:]])
    return lower + (upper - lower) * jitter


def held(edges_m: Float[Tensor, "rays edges"], depths_m: Float[Tensor, "rays depths"]) -> Float[Tensor, "rays bins"]:
    """How many of a ray's depths lie in each of its bins; those before the first edge, such as 0, in none."""
    depths_m = depths_m[:, :, None]
    is_held = (edges_m[:, None, :-1] <= depths_m) & (depths_m < edges_m[:, None, 1:])
    return is_held.sum(1).to(edges_m)


def resample(
    edges: Float[Tensor, "rays edges"],
    weights: Float[Tensor, "rays bins"],
    sample_count: int,
    jitter: Float[Tensor, "rays 1"] | None,
    padding: float,
) -> Float[Tensor, "rays new_edges"]:
    """Edges s of `sample_count` new bins, dense where the histogram is heavy.

    Inverse-transform sampling at equally spaced quantiles; `padding` is added to every weight first, so
    that no stretch of the ray goes without samples. Without `jitter` each quantile is the middle of its share.
    """
    offset = torch.full_like(edges[:, :1], 0.5) if jitter is None else jitter
    way = _in_one_pass if edges.device.type == "cpu" else _in_passes
    return way(edges, weights.detach(), sample_count, offset, padding)


def _in_passes(edges: Tensor, weights: Tensor, sample_count: int, offset: Tensor, padding: float) -> Tensor:
    """`resample`, one operator after the other."""
    padded = weights + padding
    total = padded.sum(-1, keepdim=True)
    lacking = torch.relu(LEAST_WEIGHT - total)
    density = (padded + lacking / padded.shape[-1]) / (total + lacking)
    reached = torch.cat([torch.zeros_like(density[:, :1]), density.cumsum(-1).clamp_max(1)], -1)
    quantiles = (torch.arange(sample_count + 1, dtype=weights.dtype, device=weights.device) + offset) / (
        sample_count + 1
    )
    return _interpolate(quantiles, reached, edges)


def _interpolate(at: Tensor, known: Tensor, values: Tensor) -> Tensor:
    """Piecewise-linear `values` over ascending `known`, at the places `at`; all (rays, any)."""
    above = torch.searchsorted(known, at, right=True).clamp(1, known.shape[-1] - 1)
    low, high = known.gather(-1, above - 1), known.gather(-1, above)
    share = ((at - low) / (high - low).clamp_min(1e-12)).clamp(0, 1)
    first, last = values.gather(-1, above - 1), values.gather(-1, above)
    return first + share * (last - first)


def _in_one_pass(edges: Tensor, weights: Tensor, sample_count: int, offset: Tensor, padding: float) -> Tensor:
    """`resample`, ray by ray."""
    result = edges.new_empty(len(edges), sample_count + 1)
    known, heavy, start = (tensor.contiguous().numpy() for tensor in (edges, weights, offset))
    _resample_rays(known, heavy, start, padding, result.numpy())
    return result


@numba.njit(parallel=True, error_model="numpy", cache=True)
def _resample_rays(edges, weights, offset, padding, result):
    """Fill the new edges; a quantile after the other, each looks for its bin from where the one before it was."""
    bins, count = weights.shape[1], result.shape[1]
    for ray in prange(len(edges)):
        total = bins * padding
        for i in range(bins):
            total += weights[ray, i]
        lacking = max(LEAST_WEIGHT - total, 0.0)
        scale, extra = 1 / (total + lacking), padding + lacking / bins
        bin, below, above = 0, 0.0, (weights[ray, 0] + extra) * scale
        for n in range(count):
            quantile = (n + offset[ray, 0]) / count
            while above <= quantile and bin < bins - 1:
                bin += 1
                below, above = above, above + (weights[ray, bin] + extra) * scale
            share = min(max((quantile - below) / max(above - below, 1e-12), 0.0), 1.0)
            result[ray, n] = edges[ray, bin] + share * (edges[ray, bin + 1] - edges[ray, bin])
