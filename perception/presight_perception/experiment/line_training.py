"""Training of a line model on the bird's-eye view of a raster mapper, which it keeps as it is.

Sets of lines take far longer to learn than masks: what a decoder asks of the bird's-eye view changes with every new
pairing of queries and lines. Here the raster mapper has learned the view, with the same senses and the same seed, and
the decoder alone learns, on features that are made once and kept. A step costs a tenth of one of the whole model.
"""

from pathlib import Path

import torch
from torch import Tensor, nn

from presight_core.progress import Progress, Report
from presight_perception.dataset import collate
from presight_perception.experiment.material import Material
from presight_perception.experiment.runs import Run
from presight_perception.experiment.tasks import Task
from presight_perception.experiment.training import Training
from presight_perception.models.line_model import LineModel
from presight_perception.models.line_truth import LineTruth
from presight_perception.models.raster_mapper import RasterMapper

DRAWS = 2  # of what is hidden of each keyframe's prior
CHUNK = 4  # keyframes at once


class LineTraining(Training):
    """The steps of a decoder of lines."""

    def __init__(
        self, run: Run, task: Task, material: Material, model: nn.Module, checkpoint: Path, teacher: nn.Module
    ) -> None:
        assert isinstance(model, LineModel)
        assert isinstance(teacher, RasterMapper)
        model.bev.load_state_dict(teacher.bev.state_dict())
        model.bev.requires_grad_(False)
        super().__init__(run, task, material, model, checkpoint)
        self._lines_model, self._features = model, torch.empty(0)
        self._truths: list[LineTruth] = [task.truth(model, keyframe) for keyframe in material.train]

    def _prepare(self, report: Report) -> None:
        """Make the features (draws, keyframes, channels, rows, columns) of all training keyframes."""
        self._model.eval()
        keyframes, draws = self._material.train, DRAWS if self._prior is not None else 1
        chunks = [range(first, min(first + CHUNK, len(keyframes))) for first in range(0, len(keyframes), CHUNK)]
        made: list[Tensor] = []
        for draw in range(draws):
            if self._prior is not None:
                self._prior.set_epoch(draw)
            for rows in chunks:
                made.append(self._look(list(rows)))
                report(Progress(f"{self._run.title}, bird's-eye views", len(made), draws * len(chunks)))
        self._features = torch.cat(made).unflatten(0, (draws, len(keyframes)))
        self._model.train()
        self._lines_model.bev.eval()

    @torch.no_grad()
    def _look(self, rows: list[int]) -> Tensor:
        keyframes = [self._material.train[row] for row in rows]
        images, rig = self._material.online(keyframes) if self._run.cameras else (None, None)
        prior = collate([self._prior[row] for row in rows]) if self._prior is not None else None
        return self._lines_model.bev(images, rig, prior).half()

    def _losses(self, rows: list[int]) -> dict[str, Tensor]:
        """Of every sample one of its draws, every other batch turned by half a circle, which no line minds."""
        draws = torch.randint(len(self._features), (len(rows),))
        features = self._features[draws, rows].float()
        truths = [self._truths[row] for row in rows]
        if torch.rand(()) < 0.5:
            features = features.flip(2, 3)
            truths = [LineTruth(truth.labels, 1 - truth.lines) for truth in truths]
        return self._lines_model.loss(self._lines_model.predict(features), truths)
