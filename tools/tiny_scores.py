"""How good the tiny networks are on streets they never saw."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from tiny_network import FEATURE_STRIDE

from presight_core.classes import CITYSCAPES

NEIGHBOURS = 10
REFERENCE_PATCHES, QUERY_PATCHES = 20_000, 5_000  # enough for the accuracy's second digit


@dataclass(frozen=True)
class Scores:
    """Measured on images of unseen cities; intersections over unions of the classes that occur, in 0..1."""

    class_iou: dict[str, float]
    class_share: dict[str, float]  # of the pixels
    light_iou: dict[str, float]  # the mean over the classes, for every kind of light
    pixel_accuracy: float
    constant_guess_accuracy: float  # of calling every pixel the most frequent class
    neighbour_accuracy: float  # class of a patch by its nearest patches in the features of other cities

    @property
    def mean_iou(self) -> float:
        return float(np.mean(list(self.class_iou.values())))

    def frequencies(self) -> str:
        """One line: how much of the images the classes fill."""
        return ", ".join(f"{name} {value:.2%}" for name, value in self.class_share.items())

    def summary(self) -> str:
        """One line for a model card."""
        classes = ", ".join(f"{name} {value:.2f}" for name, value in self.class_iou.items())
        lights = ", ".join(f"{name} {value:.2f}" for name, value in self.light_iou.items())
        return (
            f"On {len(self.class_iou)} classes of unseen procedural cities: mIoU {self.mean_iou:.2f} ({classes}), "
            f"by light {lights}, "
            f"pixel accuracy {self.pixel_accuracy:.2f} (a constant guess: {self.constant_guess_accuracy:.2f}); "
            f"{NEIGHBOURS}-nearest-neighbour accuracy of the features {self.neighbour_accuracy:.2f}."
        )


def confusion(predicted: NDArray[np.uint8], labels: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Counts (19, 19) of pixels by true class (rows) and predicted class; unknown pixels are left out.

    A prediction counts for all pixels of its cell, as in the pipeline.
    """
    count, stride = len(CITYSCAPES), labels.shape[-1] // predicted.shape[-1]
    predicted = predicted.repeat(stride, -2).repeat(stride, -1)
    known = labels < count
    pairs = labels[known].astype(np.int64) * count + predicted[known]
    return np.bincount(pairs, minlength=count * count).reshape(count, count)


def neighbour_accuracy(features: NDArray[np.float32], labels: NDArray[np.uint8], rng: np.random.Generator) -> float:
    """How often the nearest patches of other cities name a patch's class rightly.

    Features (N, 64, h, w) and label maps (N, 8h, 8w), in the order of cities: the first half of the images holds
    the reference patches, the second half the queries.
    """
    middle = FEATURE_STRIDE // 2
    classes = labels[:, middle::FEATURE_STRIDE, middle::FEATURE_STRIDE]
    half = len(features) // 2
    reference, reference_class = _patches(features[:half], classes[:half], REFERENCE_PATCHES, rng)
    query, query_class = _patches(features[half:], classes[half:], QUERY_PATCHES, rng)
    nearest = torch.cdist(query, reference).topk(NEIGHBOURS, largest=False).indices
    voted = torch.mode(reference_class[nearest], dim=1).values
    return float((voted == query_class).float().mean())


def scores(by_light: Mapping[str, NDArray[np.int64]], neighbours: float) -> Scores:
    """Scores from the confusion counts of all images of every kind of light."""
    matrix = np.sum(list(by_light.values()), axis=0)
    true = matrix.sum(1)
    return Scores(
        class_iou=_class_iou(matrix),
        class_share={name: float(true[k] / true.sum()) for k, name in enumerate(CITYSCAPES) if true[k]},
        light_iou={light: float(np.mean(list(_class_iou(part).values()))) for light, part in by_light.items()},
        pixel_accuracy=float(np.trace(matrix) / true.sum()),
        constant_guess_accuracy=float(true.max() / true.sum()),
        neighbour_accuracy=neighbours,
    )


def _class_iou(matrix: NDArray[np.int64]) -> dict[str, float]:
    right, true, predicted = np.diag(matrix), matrix.sum(1), matrix.sum(0)
    iou = right / np.maximum(true + predicted - right, 1)
    return {name: float(iou[k]) for k, name in enumerate(CITYSCAPES) if true[k]}


def _patches(
    features: NDArray[np.float32], classes: NDArray[np.uint8], count: int, rng: np.random.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    flat = features.transpose(0, 2, 3, 1).reshape(-1, features.shape[1])
    known = np.flatnonzero(classes.ravel() < len(CITYSCAPES))
    chosen = rng.choice(known, min(count, len(known)), replace=False)
    return torch.from_numpy(flat[chosen]), torch.from_numpy(classes.ravel()[chosen].astype(np.int64))
