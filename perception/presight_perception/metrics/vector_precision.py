"""Average precision of predicted map lines (the paper's AP; StreamMapNet's evaluator, and MapTR's as a setting)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from presight_core.errors import InputError
from presight_perception.map_truth import MAP_CLASSES
from presight_perception.metrics.polyline import Polyline, chamfer_matrix_m, resample

THRESHOLDS_M = {  # by the range's length and width, metres; the larger range is harder to draw exactly
    (100.0, 50.0): (1.0, 1.5, 2.0),
    (60.0, 30.0): (0.5, 1.0, 1.5),
}


@dataclass(frozen=True)
class VectorSettings:
    """When a predicted line counts as found, and for which classes. A label is a class's place in `classes`."""

    thresholds_m: tuple[float, ...] = THRESHOLDS_M[100.0, 50.0]
    point_count: int = 200  # a line is compared by so many points at equal steps
    classes: tuple[str, ...] = MAP_CLASSES

    @staticmethod
    def for_range(length_m: float, width_m: float) -> "VectorSettings":
        """The paper's thresholds for a range. Raises InputError for a range without any."""
        if (length_m, width_m) not in THRESHOLDS_M:
            known = ", ".join(f"{length:g} x {width:g}" for length, width in THRESHOLDS_M)
            raise InputError(
                f"no thresholds are customary for a range of {length_m:g} x {width_m:g} m, only for {known}; "
                "give VectorSettings(thresholds_m=...)"
            )
        return VectorSettings(THRESHOLDS_M[length_m, width_m])


# MapTR compares lines only where their 2 m outlines meet: within 1.5 m they always do, so that gate is left out.
MAPTR_SETTINGS = VectorSettings((0.5, 1.0, 1.5), 100, ("divider", "ped_crossing", "boundary"))


@dataclass(frozen=True)
class ScoredLines:
    """A model's lines of one sample: polylines in ego metres, with a class label and a score each."""

    lines: Sequence[Polyline]
    labels: NDArray[np.int64]  # (N,)
    scores: NDArray[np.floating]  # (N,) higher is surer

    @staticmethod
    def none() -> "ScoredLines":
        """No line at all."""
        return ScoredLines([], np.zeros(0, np.int64), np.zeros(0))


@dataclass(frozen=True)
class VectorScores:
    """Average precisions, 0..1."""

    per_threshold: dict[str, dict[float, float]]  # by class and threshold, metres

    @property
    def per_class(self) -> dict[str, float]:
        """The mean over the thresholds, by class."""
        return {name: float(np.mean(list(values.values()))) for name, values in self.per_threshold.items()}

    @cached_property
    def mean(self) -> float:
        """mAP: the mean over the classes."""
        return float(np.mean(list(self.per_class.values())))


class VectorPrecision:
    """Collects, of every prediction, its score and whether it found a line; a few bytes a prediction."""

    def __init__(self, settings: VectorSettings | None = None) -> None:
        self._settings = settings or VectorSettings()
        self._scores: dict[str, list[NDArray]] = {name: [] for name in self._settings.classes}
        self._found: dict[str, list[NDArray]] = {name: [] for name in self._settings.classes}
        self.true_count = dict.fromkeys(self._settings.classes, 0)

    def add(self, predicted: ScoredLines, true_lines: Mapping[str, Sequence[Polyline]]) -> dict[str, NDArray[np.bool_]]:
        """Count one sample; by class, which of its predictions (N, thresholds) found a line, in the order given."""
        return {
            name: self._add_class(name, *_of_label(predicted, label), true_lines.get(name, []))
            for label, name in enumerate(self._settings.classes)
        }

    def result(self) -> VectorScores:
        """The average precision of everything added; 0 for a class without a true line."""
        thresholds = self._settings.thresholds_m
        return VectorScores(
            {name: dict(zip(thresholds, self._precisions(name), strict=True)) for name in self._settings.classes}
        )

    def _add_class(
        self, name: str, lines: Sequence[Polyline], scores: NDArray, true_lines: Sequence[Polyline]
    ) -> NDArray[np.bool_]:
        count, limit_m = self._settings.point_count, max(self._settings.thresholds_m)
        sampled, true_sampled = ([resample(line, count) for line in group] for group in (lines, true_lines))
        distances = chamfer_matrix_m(sampled, true_sampled, limit_m)
        found = np.stack([match(distances, scores, limit) for limit in self._settings.thresholds_m], -1)
        self._scores[name].append(scores.astype(np.float32))
        self._found[name].append(found)
        self.true_count[name] += len(true_lines)
        return found

    def _precisions(self, name: str) -> list[float]:
        thresholds = len(self._settings.thresholds_m)
        scores = np.concatenate([np.zeros(0, np.float32), *self._scores[name]])
        found = np.concatenate([np.zeros((0, thresholds), np.bool_), *self._found[name]])
        found = found[np.argsort(-scores, kind="stable")]
        return [average_precision(found[:, index], self.true_count[name]) for index in range(thresholds)]


def match(distances_m: NDArray[np.float64], scores: NDArray, threshold_m: float) -> NDArray[np.bool_]:
    """Which predictions (N,) find a true line, by distances (N, M), the surest first.

    Each looks at its nearest true line alone: if that is too far or already found, the prediction is false,
    even if another one is near enough.
    """
    found = np.zeros(len(scores), np.bool_)
    if not distances_m.shape[1]:
        return found
    taken = np.zeros(distances_m.shape[1], np.bool_)
    nearest = distances_m.argmin(1)
    for row in np.argsort(-scores, kind="stable"):
        column = nearest[row]
        found[row] = distances_m[row, column] <= threshold_m and not taken[column]
        taken[column] |= found[row]
    return found


def average_precision(found: NDArray[np.bool_], true_count: int) -> float:
    """Area under the falling envelope of precision over recall; predictions in descending order of score."""
    if not true_count or not len(found):
        return 0.0
    hits = np.cumsum(found)
    precision = hits / np.arange(1, len(found) + 1)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    return float(envelope[found].sum() / true_count)  # recall rises by 1 / true_count at each hit


def _of_label(predicted: ScoredLines, label: int) -> tuple[list[Polyline], NDArray]:
    rows = np.flatnonzero(np.asarray(predicted.labels) == label).tolist()
    return [predicted.lines[row] for row in rows], np.asarray(predicted.scores)[rows]
