"""Weights along rays that are followed no further than something is left of them."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from presight_core.field.rays import Rays
from presight_core.field.rendering import ray_weights

STAGES = 8  # of the samples of a ray; it is followed from one to the next
MIN_SAMPLES = 8  # of a stage: fewer are not worth the bookkeeping


def weights_until(
    density_at: Callable[[Tensor], Tensor], rays: Rays, edges_m: Tensor, left: float, fog: float = 0.0
) -> Tensor:
    """`ray_weights` (rays, bins) of the densities at points, zero beyond where at most `left` of a ray is left.

    Behind a surface there is nothing to see, and half of all samples lie there. What is thinner than `fog`, per metre,
    counts as nothing. Without gradients.
    """
    stage = samples_of_stage(edges_m.shape[1] - 1)
    density = torch.zeros_like(edges_m[:, 1:])
    followed, optical = torch.arange(len(edges_m), device=edges_m.device), edges_m.new_zeros(len(edges_m))
    for first in range(0, density.shape[1], stage):
        edges = edges_m[followed, first : first + stage + 1]
        part = density_at(Rays(rays.origins[followed], rays.directions[followed]).points(edges))
        part = torch.where(part < fog, 0, part)
        density[followed, first : first + stage] = part
        optical = optical + (part * edges.diff(dim=-1)).sum(-1)
        unfinished = optical < -math.log(left)
        followed, optical = followed[unfinished], optical[unfinished]
        if not len(followed):
            break
    return ray_weights(density, edges_m.diff(dim=-1))


def samples_of_stage(bins: int) -> int:
    """How many samples of a ray with so many are looked at before asking whether to go on."""
    return max(MIN_SAMPLES, bins // STAGES)
