"""Losses of occupancy models: cross-entropy, focal, Lovász, scene-class affinity, and of depth.

Those of voxels take logits (V, classes) and classes (V,) of the voxels that count, of the whole batch; without any
voxel they are 0.
"""

import torch
from torch import Tensor
from torch.nn import functional

LEAST_SHARE = 1e-5  # of a precision or recall, lest its logarithm be infinite


def cross_entropy_loss(logits: Tensor, classes: Tensor, weights: Tensor | None = None) -> Tensor:
    """The mean over voxels, weighted by those of their classes, if given."""
    total = len(classes) if weights is None else weights[classes].sum().item()
    return functional.cross_entropy(logits, classes, weights, reduction="sum") / max(1, total)


def focal_loss(logits: Tensor, classes: Tensor, weights: Tensor, gamma: float = 2.0, alpha: float = 0.25) -> Tensor:
    """Sigmoid focal loss, summed over classes, the mean over voxels; weights (V, classes)."""
    target = functional.one_hot(classes, logits.shape[1]).to(logits.dtype)
    error = (logits.sigmoid() - target).abs()
    balance = alpha * target + (1 - alpha) * (1 - target)
    entropy = functional.binary_cross_entropy_with_logits(logits, target, reduction="none")
    return (weights * balance * error**gamma * entropy).sum() / max(1, len(classes))


def lovasz_loss(probabilities: Tensor, classes: Tensor) -> Tensor:
    """The Lovász extension of the Jaccard loss, the mean over the classes present (Berman et al., 2018, eq. 9)."""
    present = classes.unique()
    if not len(present):
        return probabilities.sum() * 0
    is_class = (classes[:, None] == present).to(probabilities.dtype)
    errors, order = (is_class - probabilities[:, present]).abs().sort(0, descending=True)
    return (errors * _jaccard_steps(is_class.gather(0, order))).sum(0).mean()


def semantic_affinity_loss(probabilities: Tensor, classes: Tensor, free: int) -> Tensor:
    """Scene-class affinity of the occupied classes that are present (MonoScene, eq. 6, all parts of it)."""
    occupied = classes.unique()
    occupied = occupied[occupied != free]
    if not len(occupied):
        return probabilities.sum() * 0
    is_class = (classes[:, None] == occupied).to(probabilities.dtype)
    return _affinity(probabilities[:, occupied], is_class).mean()


def geometric_affinity_loss(probabilities: Tensor, classes: Tensor, free: int) -> Tensor:
    """The same of occupied against free space."""
    is_occupied = (classes != free).to(probabilities.dtype)
    return _affinity(1 - probabilities[:, free : free + 1], is_occupied[:, None]).mean()


def depth_loss(depth: Tensor, bins: Tensor) -> Tensor:
    """Binary cross-entropy of depth distributions, summed over bins, the mean over pixels with a known depth.

    depth (B, N, D, H, W) probabilities; bins (B, N, H, W) int64 true bin, -1 where unknown.
    """
    known = bins >= 0
    found = depth.permute(0, 1, 3, 4, 2)[known]
    target = functional.one_hot(bins[known], depth.shape[2]).to(depth.dtype)
    return functional.binary_cross_entropy(found, target, reduction="sum") / known.sum().clamp(min=1)


def _jaccard_steps(is_class: Tensor) -> Tensor:
    """How the Jaccard loss grows with each further wrong voxel: is_class (V, classes), greatest error first."""
    total = is_class.sum(0)
    intersection = total - is_class.cumsum(0)
    union = total + (1 - is_class).cumsum(0)
    jaccard = 1 - intersection / union
    return torch.cat([jaccard[:1], jaccard[1:] - jaccard[:-1]])


def _affinity(probabilities: Tensor, is_class: Tensor) -> Tensor:
    """Negative logarithms (classes,) of precision, recall and specificity, summed; of what is (V, classes)."""
    hits, other = (probabilities * is_class).sum(0), 1 - is_class
    precision = hits / (probabilities.sum(0) + LEAST_SHARE)
    recall = hits / (is_class.sum(0) + LEAST_SHARE)
    specificity = ((1 - probabilities) * other).sum(0) / (other.sum(0) + LEAST_SHARE)
    shares = LEAST_SHARE + (1 - LEAST_SHARE) * torch.stack([precision, recall, specificity])
    without_others = other.sum(0) == 0  # then there is nothing to be specific about
    return -(shares[:2].log().sum(0) + shares[2].log().masked_fill(without_others, 0.0))
