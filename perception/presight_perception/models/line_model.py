"""What the models that predict lines share: their truth and their loss."""

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from presight_perception.map_truth import MapLines
from presight_perception.metrics import ScoredLines
from presight_perception.models.bev_features import BevSettings
from presight_perception.models.line_loss import LineLossSettings, LinePredictions, line_losses
from presight_perception.models.line_truth import LineSettings, LineTruth, line_truth
from presight_perception.models.map_model import MapModel


class LineModel(MapModel[LinePredictions, LineTruth]):
    """A map model that predicts lines, matches them with the true ones, and is trained on the matched pairs."""

    def __init__(self, bev: BevSettings, lines: LineSettings, loss: LineLossSettings) -> None:
        super().__init__(bev)
        self._grid, self._lines, self._loss = bev.grid, lines, loss

    def truth_of(self, lines: MapLines) -> LineTruth:
        return line_truth(lines, self._grid, self._lines)

    def loss(self, predictions: LinePredictions, truths: Sequence[LineTruth]) -> dict[str, Tensor]:
        return line_losses(predictions, truths, self._grid, self._loss)


def scored_lines(lines_m: Tensor, labels: Tensor, scores: Tensor) -> ScoredLines:
    """Lines (N, points, 2) with labels and scores (N,) as the metric takes them."""
    lines, label_array, score_array = (part.detach().cpu().numpy() for part in (lines_m, labels, scores))
    return ScoredLines(list(lines.astype(np.float64)), label_array, score_array)
