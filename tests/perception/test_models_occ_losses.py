"""The losses of occupancy models against their definitions, in plain loops."""

import numpy as np
import pytest
import torch

from presight_perception.models.lift_splat import DepthBins, depth_bins
from presight_perception.models.occ_losses import (
    cross_entropy_loss,
    depth_loss,
    focal_loss,
    geometric_affinity_loss,
    lovasz_loss,
    semantic_affinity_loss,
)

RANDOM = np.random.default_rng(0)
LOGITS = RANDOM.normal(size=(30, 4))
PROBABILITIES = np.exp(LOGITS) / np.exp(LOGITS).sum(1, keepdims=True)
CLASSES = RANDOM.choice([0, 1, 3], 30)  # class 2 is absent
FREE = 3


def tensors(*arrays: np.ndarray) -> list[torch.Tensor]:
    return [torch.from_numpy(array) for array in arrays]


def jaccard_loss(wrong: set[int], own: set[int]) -> float:
    """Of a class whose true voxels are `own`, if the voxels `wrong` are wrong."""
    return len(wrong) / len(own | wrong)


def test_lovasz_is_the_extension_of_the_jaccard_loss():
    losses = []
    for class_ in (0, 1, 3):
        own = set(np.flatnonzero(class_ == CLASSES))
        errors = np.abs((class_ == CLASSES) - PROBABILITIES[:, class_])
        total, wrong = 0.0, set()
        for voxel in np.argsort(-errors):
            total += errors[voxel] * (jaccard_loss(wrong | {voxel}, own) - jaccard_loss(wrong, own))
            wrong.add(voxel)
        losses.append(total)
    assert lovasz_loss(*tensors(PROBABILITIES, CLASSES)).item() == pytest.approx(np.mean(losses))


def test_lovasz_of_certain_predictions_is_the_jaccard_loss():
    found = np.array([0, 0, 1, 1, 1])
    true = np.array([0, 1, 1, 1, 0])
    expected = np.mean([jaccard_loss({1, 4}, {0, 4}), jaccard_loss({1, 4}, {1, 2, 3})])
    assert lovasz_loss(*tensors(np.eye(2)[found], true)).item() == pytest.approx(expected)


def affinity(probability: np.ndarray, true: np.ndarray) -> float:
    precision = probability[true].sum() / probability.sum()
    recall = probability[true].mean()
    specificity = (1 - probability[~true]).mean()
    return -np.log([precision, recall, specificity]).sum()


def test_semantic_affinity_is_of_the_occupied_classes_present():
    expected = np.mean([affinity(PROBABILITIES[:, class_], class_ == CLASSES) for class_ in (0, 1)])
    assert semantic_affinity_loss(*tensors(PROBABILITIES, CLASSES), FREE).item() == pytest.approx(expected, abs=1e-3)


def test_geometric_affinity_is_of_occupied_against_free():
    expected = affinity(1 - PROBABILITIES[:, FREE], CLASSES != FREE)
    assert geometric_affinity_loss(*tensors(PROBABILITIES, CLASSES), FREE).item() == pytest.approx(expected, abs=1e-3)


def test_focal_loss_equals_a_loop():
    weights, total = RANDOM.random((30, 4)), 0.0
    for voxel, class_ in np.ndindex(30, 4):
        chance = 1 / (1 + np.exp(-LOGITS[voxel, class_]))
        if CLASSES[voxel] == class_:
            total -= weights[voxel, class_] * 0.25 * (1 - chance) ** 2 * np.log(chance)
        else:
            total -= weights[voxel, class_] * 0.75 * chance**2 * np.log(1 - chance)
    assert focal_loss(*tensors(LOGITS, CLASSES, weights)).item() == pytest.approx(total / 30)


def test_losses_without_any_voxel_are_zero_and_can_be_differentiated():
    logits = torch.zeros(0, 4, requires_grad=True)
    classes = torch.zeros(0, dtype=torch.int64)
    parts = [
        cross_entropy_loss(logits, classes),
        focal_loss(logits, classes, torch.zeros(0, 4)),
        lovasz_loss(logits.softmax(1), classes),
        semantic_affinity_loss(logits.softmax(1), classes, FREE),
    ]
    assert [part.item() for part in parts] == [0.0] * 4
    sum(parts).backward()


def test_affinity_pulls_at_a_class_that_is_not_found_at_all():
    logits = torch.tensor([[20.0, 0.0], [20.0, 0.0]], requires_grad=True)
    semantic_affinity_loss(logits.softmax(1), torch.tensor([1, 1]), 0).backward()
    assert (logits.grad[:, 1] < 0).all()


def test_depth_loss_is_of_pixels_with_a_known_depth():
    depth = torch.tensor([0.7, 0.2, 0.1]).view(1, 1, 3, 1, 1).expand(1, 1, 3, 2, 2)
    bins = torch.tensor([[[[1, -1], [-1, -1]]]])
    expected = -(np.log(0.3) + np.log(0.2) + np.log(0.9))
    assert depth_loss(depth, bins).item() == pytest.approx(expected)


def test_a_feature_pixel_has_the_bin_of_its_nearest_known_depth():
    depth_m = torch.zeros(1, 1, 4, 4)
    depth_m[0, 0, 0, 0], depth_m[0, 0, 1, 1] = 7.9, 5.1  # top left
    depth_m[0, 0, 3, 3] = 60.0  # beyond the bins
    depth_m[0, 0, 0, 3] = 1.0  # the first bin's nearer face
    bins = depth_bins(depth_m, (2, 2), DepthBins(1.0, 11.0, 0.5))
    assert bins[0, 0].tolist() == [[8, 0], [-1, -1]]


def test_weighted_voxels_count_as_often_as_their_classes_weigh():
    logits, classes = torch.randn(6, 3), torch.tensor([0, 1, 1, 2, 2, 2])
    rows = torch.tensor([0, 0, 0, 1, 2, 3, 4, 5])
    weighted = cross_entropy_loss(logits, classes, torch.tensor([3.0, 1.0, 1.0]))
    torch.testing.assert_close(weighted, cross_entropy_loss(logits[rows], classes[rows]))
