"""Try a trained model on the test scenes, as a probe says."""

import time
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from presight_core.progress import Progress, Report, silent
from presight_perception.dataset import PriorBatch, PriorSample, collate
from presight_perception.experiment.keyframes import Keyframe
from presight_perception.experiment.map_memory import MapMemory
from presight_perception.experiment.material import Material
from presight_perception.experiment.runs import Probe, Run
from presight_perception.experiment.tasks import Figures, MapTask, MaskScorer, Scorer, Task
from presight_perception.models.nmp_raster_mapper import NmpRasterMapper
from presight_perception.models.raster_mapper import RasterMapperSettings
from presight_perception.voxelise import BevAugmentation

BATCH = 4
LEVELS = 50  # of the thresholds that a constant mask is cut at


class Trial:
    """One trained model under one probe."""

    def __init__(self, model: nn.Module, run: Run, probe: Probe, task: Task, material: Material) -> None:
        self._model, self._run, self._probe = model, run, probe
        self._task, self._material = task, material
        self._prior = material.test_prior(run, probe, task.prior_grid)
        self._memory = None
        if isinstance(model, NmpRasterMapper):
            self._memory = MapMemory(model)
            self._memory.drive(material.prior_drives(probe), material)

    def figures(self, report: Report = silent) -> dict[str, Figures]:
        """Figures over all test keyframes, and over groups of them, see `Material.groups_of`.

        Among those of all is "fps", keyframes a second of processor time, images not yet decoded left out.
        """
        count, spent_s = len(self._material.test), 0.0
        scorers: dict[str, Scorer] = defaultdict(lambda: self._task.scorer(self._model))
        for first in range(0, count, BATCH):
            rows = range(first, min(first + BATCH, count))
            self._decode_images(rows)
            started_s = time.process_time()
            decoded = self.found(rows)
            spent_s += time.process_time() - started_s
            for row, found in zip(rows, decoded, strict=True):
                _add(scorers, found, self._material.test[row], self._material)
            report(Progress(f"{self._run.title}, tried", rows[-1] + 1, count))
        figures = {name: scorer.result() for name, scorer in scorers.items()}
        figures["all"]["fps"] = count / spent_s
        return figures

    def _decode_images(self, rows: Sequence[int]) -> None:
        for row in rows:
            keyframe = self._material.test[row]
            for each in (keyframe, self._material.earlier(keyframe)):
                self._material.image(each.token)  # which keeps it

    def found(self, rows: Sequence[int]) -> Sequence[Any]:
        """What the model finds in some test keyframes, decoded."""
        with torch.inference_mode():
            return self._model.decode(self._predictions(rows))  # pyright: ignore[reportCallIssue]

    def prior(self, rows: Sequence[int]) -> PriorBatch:
        """The prior around some test keyframes. Only for runs with one."""
        assert self._prior is not None
        if not self._probe.mirrored:
            return collate([self._prior[row] for row in rows])
        mirror, straight = BevAugmentation(flip_y=True), BevAugmentation()
        draws = np.random.default_rng(0)  # of noise, which such a probe has none of
        return collate([PriorSample(self._prior.voxels(row, mirror, draws), straight) for row in rows])

    def _predictions(self, rows: Sequence[int]) -> Any:
        keyframes = [self._material.test[row] for row in rows]
        online = self._run.cameras and self._probe.cameras
        images, rig = self._material.online(keyframes) if online else (None, None)
        if self._memory is not None and images is not None and rig is not None:
            return self._memory.predict(images, rig, keyframes, remember=False)
        more = self._task.more_inputs(keyframes, self._material) if images is not None else {}
        return self._model(images, rig, None if self._prior is None else self.prior(rows), **more)


def constant_mask_figures(task: MapTask, material: Material) -> dict[str, Figures]:
    """Figures of one mask for all samples, without any model: where the training truth most often has a class."""
    settings = RasterMapperSettings.tiny()
    truth = MaskScorer(task, settings)
    trained = np.stack([truth.true_masks(keyframe) for keyframe in material.train])
    masks = np.stack([_best_cut(trained[:, each]) for each in range(trained.shape[1])])
    scorers: dict[str, Scorer] = defaultdict(lambda: MaskScorer(task, settings))
    for keyframe in material.test:
        _add(scorers, masks, keyframe, material)
    return {name: scorer.result() for name, scorer in scorers.items()}


def _add(scorers: dict[str, Scorer], found: Any, keyframe: Keyframe, material: Material) -> None:
    for group in material.groups_of(keyframe.token):
        scorers[group].add(found, keyframe)


def _best_cut(masks: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask (H, W) that overlaps the masks (N, H, W) best, of those that cut their mean at one level."""
    mean = masks.mean(0)

    def overlap(level: float) -> float:
        cut = mean >= level
        common = masks[:, cut].sum()
        return common / (masks.sum() + cut.sum() * len(masks) - common)

    return mean >= max(np.linspace(0, mean.max(), LEVELS + 1)[1:], key=overlap)
