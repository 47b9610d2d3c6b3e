"""Mean intersection over union of semantic occupancy (the paper's mIoU), from one 18 x 18 histogram."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from presight_core.errors import InputError
from presight_perception.occupancy_truth import (
    DYNAMIC_CLASSES,
    OCCUPANCY_CLASSES,
    OCCUPIED_CLASSES,
    STATIC_CLASSES,
    OccupancyTruth,
)

Mask = Literal["camera", "lidar", "none"]
Absent = Literal["left out", "zero", "zero if predicted"]

CLASS_COUNT = len(OCCUPANCY_CLASSES)


@dataclass(frozen=True)
class OccupancyScores:
    """Scores from a histogram of voxels: rows are true classes, columns predicted ones."""

    histogram: NDArray[np.int64]  # (18, 18)

    @property
    def per_class(self) -> dict[str, float]:
        """Intersection over union by class, 0..1; NaN where the class neither occurs nor is predicted.

        Voxels confused with free space count in the unions.
        """
        hits = np.diag(self.histogram)
        union = self.histogram.sum(0) + self.histogram.sum(1) - hits
        iou = np.divide(hits, union, out=np.full(CLASS_COUNT, np.nan), where=union > 0)
        return dict(zip(OCCUPANCY_CLASSES, iou.tolist(), strict=True))

    def mean(self, classes: tuple[str, ...] = OCCUPIED_CLASSES, absent: Absent = "left out") -> float:
        """The mean over classes; NaN if none remains.

        absent: what a class without any true voxel scores. "left out" of the mean is the honest way; "zero" is the
        paper's, which counts trailer in the means of Table 2 though the test set has none; "zero if predicted" is the
        released evaluator's, whose mean moves when a single wrong voxel is predicted.
        """
        iou = np.array([self.per_class[name] for name in classes])
        is_absent = np.array([not self.histogram[OCCUPANCY_CLASSES.index(name)].any() for name in classes])
        if absent == "left out":
            iou = iou[~is_absent]
        elif absent == "zero":
            iou = np.where(is_absent, 0.0, iou)
        kept = iou[~np.isnan(iou)]
        return float(kept.mean()) if len(kept) else float("nan")

    def summary(self, absent: Absent = "left out") -> dict[str, float]:
        """The three means of the paper's Table 2, 0..1: dynamic, static and overall."""
        groups = {"dynamic": DYNAMIC_CLASSES, "static": STATIC_CLASSES, "overall": OCCUPIED_CLASSES}
        return {name: self.mean(classes, absent) for name, classes in groups.items()}


class OccupancyIou:
    """Counts voxels, of those the mask shows: what the cameras saw (customary), the lidar saw, or all."""

    def __init__(self, mask: Mask = "camera") -> None:
        self._mask = mask
        self.histogram = np.zeros((CLASS_COUNT, CLASS_COUNT), np.int64)

    def add(self, predicted: NDArray[np.uint8], truth: OccupancyTruth) -> None:
        """Count one sample's classes (X, Y, Z). Raises InputError for another shape, or what is no class."""
        predicted = np.asarray(predicted)
        if predicted.shape != truth.semantics.shape:
            raise InputError(f"prediction of {predicted.shape}, truth of {truth.semantics.shape}; predict every voxel")
        shown = truth.semantics < CLASS_COUNT  # 255 is unknown
        if self._mask != "none":
            shown = shown & (truth.mask_camera if self._mask == "camera" else truth.mask_lidar)
        true, found = truth.semantics[shown].astype(np.int64), predicted[shown].astype(np.int64)
        if len(found) and not 0 <= found.min() <= found.max() < CLASS_COUNT:
            raise InputError(f"predicted classes {found.min()} to {found.max()}; they must be 0 to {CLASS_COUNT - 1}")
        counts = np.bincount(true * CLASS_COUNT + found, minlength=CLASS_COUNT**2)
        self.histogram += counts.reshape(CLASS_COUNT, CLASS_COUNT)

    def result(self) -> OccupancyScores:
        """The scores of everything added."""
        return OccupancyScores(self.histogram.copy())
