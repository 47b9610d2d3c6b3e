"""Intersection over union of rasterised maps, summed over the whole data set (the paper's IoU)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from presight_core.errors import InputError
from presight_perception.map_truth import MAP_CLASSES

LEAST_UNION = 1e-7  # as released: an absent class scores 0 instead of dividing by zero


@dataclass(frozen=True)
class RasterScores:
    """Intersection over union, 0..1, by class; a class that never occurs has 0 and counts in the mean."""

    per_class: dict[str, float]

    @property
    def mean(self) -> float:
        """The mean over the classes."""
        return float(np.mean(list(self.per_class.values())))


class RasterIou:
    """Sums intersections and unions of the cells of each class."""

    def __init__(self, classes: tuple[str, ...] = MAP_CLASSES) -> None:
        self._classes = classes
        self._intersections = np.zeros(len(classes), np.int64)
        self._unions = np.zeros(len(classes), np.int64)

    def add(self, predicted: NDArray[np.bool_], true: NDArray[np.bool_]) -> None:
        """Count masks (..., classes, H, W), of one sample or of many. Raises InputError if their shapes differ."""
        predicted, true = np.asarray(predicted, np.bool_), np.asarray(true, np.bool_)
        if predicted.shape != true.shape or predicted.shape[-3] != len(self._classes):
            raise InputError(
                f"masks of {predicted.shape} and {true.shape}; both must be (..., {len(self._classes)}, height, width)"
            )
        self._intersections += _per_class(predicted & true)
        self._unions += _per_class(predicted | true)

    def result(self) -> RasterScores:
        """The scores of everything added."""
        iou = self._intersections / (self._unions + LEAST_UNION)
        return RasterScores(dict(zip(self._classes, iou.tolist(), strict=True)))


def _per_class(masks: NDArray[np.bool_]) -> NDArray[np.int64]:
    cells = masks.sum((-2, -1), dtype=np.int64)
    return cells.reshape(-1, cells.shape[-1]).sum(0)
