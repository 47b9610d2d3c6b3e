"""What the tiny networks are trained to make small."""

import numpy as np
import torch
from numpy.typing import NDArray
from tiny_network import CLASS_COUNT
from torch import Tensor
from torch.nn.functional import cross_entropy, one_hot

from presight_core.classes import UNKNOWN


def class_weights(labels: NDArray[np.uint8], power: float) -> Tensor:
    """Weights (19,) of the classes' losses, frequency to the power of -`power`, 1 on average over pixels."""
    frequency = np.bincount(labels.ravel(), minlength=UNKNOWN + 1)[:CLASS_COUNT] / labels.size
    weights = np.maximum(frequency, 5e-4) ** -power  # the floor: a class of a few pixels must not rule the rest
    return torch.tensor(weights / (weights * frequency).sum(), dtype=torch.float32)


def segmentation_loss(
    logits: Tensor, labels: Tensor, weights: Tensor, rng: np.random.Generator, overlap_weight: float = 0.0
) -> Tensor:
    """Weighted cross-entropy, and the share of the classes' areas that does not overlap the truth's.

    Logits (N, 19, h, w) and labels (N, H, W): every cell is compared with one of its pixels, another at each step, on
    average with all of them.
    """
    stride = labels.shape[-1] // logits.shape[-1]
    row, column = rng.integers(stride, size=2)
    truth = labels[:, row::stride, column::stride]
    logits = logits.movedim(1, -1)  # as they lie in memory
    loss = cross_entropy(logits.reshape(-1, CLASS_COUNT), truth.reshape(-1), weights, ignore_index=UNKNOWN)
    if overlap_weight:
        row, column = rng.integers(2, size=2)  # a quarter of the cells tell the areas well enough
        part = np.s_[:, row::2, column::2]
        loss = loss + overlap_weight * missed_overlap(logits[part], truth[part])
    return loss


def missed_overlap(logits: Tensor, truth: Tensor) -> Tensor:
    """1 less the mean intersection over union of the classes in a batch, soft: probabilities stand for areas.

    Logits (..., 19), truth (...).
    """
    known = truth != UNKNOWN
    area = logits[known].softmax(-1)  # (P, 19)
    true_area = one_hot(truth[known], CLASS_COUNT)
    overlap = (area * true_area).sum(0)
    union = area.sum(0) + true_area.sum(0) - overlap
    present = true_area.sum(0) > 0
    return 1 - (overlap[present] / union[present]).mean()
