"""Losses of predicted lines: each true line is matched to one query, in its best order."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor
from torch.nn import functional

from presight_perception.models.bev_grid import BevGrid
from presight_perception.models.line_truth import LineTruth

FOCAL_ALPHA, FOCAL_GAMMA = 0.25, 2.0  # of both models
LEAST_SHARE = 1e-12  # keeps logarithms finite


@dataclass(frozen=True)
class LineLossSettings:
    """Weights of the matching's costs and of the losses, which are the same."""

    class_weight: float = 5.0
    coordinate_weight: float = 2.5  # of a share of the grid: StreamMapNet's 50, divided by its 20 points
    smooth: float = 0.01  # below this difference, the loss is a parabola; 0: never
    direction_weight: float = 0.0  # of one minus the cosine between predicted and true segments


class LinePredictions(NamedTuple):
    """Lines of Q queries after each of L decoder layers."""

    logits: Tensor  # (L, B, Q, classes)
    lines: Tensor  # (L, B, Q, points, 2) shares of the grid


class Match(NamedTuple):
    """Which query is which true line, of one sample: K pairs."""

    queries: Tensor  # (K,)
    lines: Tensor  # (K,)
    orders: Tensor  # (K,) the true line's best order


def line_losses(
    predictions: LinePredictions, truths: Sequence[LineTruth], grid: BevGrid, settings: LineLossSettings
) -> dict[str, Tensor]:
    """Sums over the decoder layers of the weighted losses, per true line of the batch."""
    truths = [LineTruth(*(part.to(predictions.lines.device) for part in truth)) for truth in truths]
    layers = [_layer_losses(logits, lines, truths, grid, settings) for logits, lines in zip(*predictions, strict=True)]
    return {name: torch.stack([layer[name] for layer in layers]).sum() for name in layers[0]}


@torch.no_grad()
def match_lines(logits: Tensor, lines: Tensor, truth: LineTruth, settings: LineLossSettings) -> Match:
    """The cheapest pairs of queries, logits (Q, classes) and lines (Q, points, 2), with true lines."""
    costs = coordinate_costs(lines, truth.lines, settings.smooth)
    least, orders = costs.min(-1)
    total = settings.coordinate_weight * least + settings.class_weight * _class_costs(logits)[:, truth.labels]
    rows, columns = (torch.as_tensor(side, device=lines.device) for side in linear_sum_assignment(total.cpu().numpy()))
    return Match(rows, columns, orders[rows, columns])


def coordinate_costs(lines: Tensor, true_lines: Tensor, smooth: float) -> Tensor:
    """Sums (Q, G, O) of differences between lines (Q, points, 2) and true lines (G, O, points, 2)."""
    flat, true_flat = lines.flatten(1), true_lines.flatten(2)
    if not smooth:
        return torch.cdist(flat, true_flat.flatten(0, 1), p=1).view(len(flat), *true_flat.shape[:2])
    difference = (flat[:, None, None] - true_flat).abs()
    return torch.where(difference < smooth, difference**2 / (2 * smooth), difference - smooth / 2).sum(-1)


def focal_loss(logits: Tensor, targets: Tensor) -> Tensor:
    """The sum of sigmoid focal losses of logits against targets 0 and 1 of the same shape."""
    probability = logits.sigmoid()
    miss = torch.where(targets > 0, 1 - probability, probability)
    weight = torch.where(targets > 0, FOCAL_ALPHA, 1 - FOCAL_ALPHA) * miss**FOCAL_GAMMA
    return (weight * functional.binary_cross_entropy_with_logits(logits, targets, reduction="none")).sum()


def direction_loss(lines_m: Tensor, true_lines_m: Tensor) -> Tensor:
    """The sum over segments of one minus the cosine between lines (K, points, 2) and true ones, in metres."""
    cosine = functional.cosine_similarity(lines_m.diff(dim=1), true_lines_m.diff(dim=1), dim=-1)
    return (1 - cosine).sum()


def _class_costs(logits: Tensor) -> Tensor:
    """What naming each class (Q, classes) adds to the focal loss."""
    probability = logits.sigmoid()
    named = -FOCAL_ALPHA * (1 - probability) ** FOCAL_GAMMA * (probability + LEAST_SHARE).log()
    unnamed = -(1 - FOCAL_ALPHA) * probability**FOCAL_GAMMA * (1 - probability + LEAST_SHARE).log()
    return named - unnamed


def _layer_losses(
    logits: Tensor, lines: Tensor, truths: Sequence[LineTruth], grid: BevGrid, settings: LineLossSettings
) -> dict[str, Tensor]:
    matches = [match_lines(*sample, settings) for sample in zip(logits, lines, truths, strict=True)]
    targets = torch.zeros_like(logits)
    for sample, (match, truth) in enumerate(zip(matches, truths, strict=True)):
        targets[sample, match.queries, truth.labels[match.lines]] = 1.0
    found = torch.cat([sample[match.queries] for sample, match in zip(lines, matches, strict=True)])
    true = torch.cat([truth.lines[match.lines, match.orders] for truth, match in zip(truths, matches, strict=True)])
    count = max(len(true), 1)
    beta = settings.smooth
    losses = {
        "class": settings.class_weight * focal_loss(logits, targets) / count,
        "line": settings.coordinate_weight * functional.smooth_l1_loss(found, true, reduction="sum", beta=beta) / count,
    }
    if settings.direction_weight:
        metres = (grid.metres_from_shares(part) for part in (found, true))
        losses["direction"] = settings.direction_weight * direction_loss(*metres) / count
    return losses
