"""What a model is for and how it is judged: lines, masks, or classes of voxels."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from presight_perception.experiment.keyframes import Keyframe, lidar_depth
from presight_perception.experiment.material import Locations, Material
from presight_perception.experiment.runs import MAP_MODELS, ModelName
from presight_perception.map_truth import MapLines, MapTruthSettings, VectorMap, rasterise
from presight_perception.metrics import (
    OccupancyIou,
    RasterIou,
    RasterScores,
    ScoredLines,
    VectorPrecision,
    VectorScores,
    VectorSettings,
)
from presight_perception.models.bev_features import TINY_GRID, Sources
from presight_perception.models.bevdet_occ import BevDetOcc, BevDetOccSettings
from presight_perception.models.fb_occ import FbOcc, FbOccSettings
from presight_perception.models.map_tr import MapTr, MapTrSettings
from presight_perception.models.occ_frames import PastFrame
from presight_perception.models.occ_model import OccupancyModel
from presight_perception.models.raster_mapper import RasterMapper, RasterMapperSettings
from presight_perception.models.stream_map_net import StreamMapNet, StreamMapNetSettings
from presight_perception.occupancy_truth import OccupancyTruth, read_occupancy
from presight_perception.voxelise import VoxelGrid

Figures = dict[str, float]  # percent, by name; "mean" is the headline

MODELS: dict[ModelName, Callable[[Sources], nn.Module]] = {
    "raster": lambda sources: RasterMapper(RasterMapperSettings.tiny(sources)),
    "stream": lambda sources: StreamMapNet(StreamMapNetSettings.tiny(sources)),
    "maptr": lambda sources: MapTr(MapTrSettings.tiny(sources)),
    "bevdet-occ": lambda sources: BevDetOcc(BevDetOccSettings.tiny(sources)),
    "fb-occ": lambda sources: FbOcc(FbOccSettings.tiny(sources)),
}


class Scorer(ABC):
    """Collects what a model found."""

    @abstractmethod
    def add(self, found: Any, keyframe: Keyframe) -> None:
        """One sample's decoded prediction."""

    @abstractmethod
    def result(self) -> Figures:
        """The figures of everything added."""


class Task(ABC):
    """Truth and scores of one kind of model."""

    prior_grid: VoxelGrid

    @abstractmethod
    def truth(self, model: Any, keyframe: Keyframe) -> Any:
        """What the model's loss compares with."""

    def more_inputs(self, keyframes: Sequence[Keyframe], material: Material) -> dict[str, Any]:
        """What a model with cameras is given besides images, rig and prior, by the argument's name."""
        return {}

    @abstractmethod
    def scorer(self, model: Any) -> Scorer:
        """A new scorer of what the model decodes."""


def task_of(name: ModelName, locations: Locations) -> Task:
    """The task of a model, on a data set."""
    return MapTask(locations.data) if name in MAP_MODELS else OccupancyTask(locations)


class MapTask(Task):
    """Crossings, dividers and boundaries of the tiny range, 60 x 30 m."""

    prior_grid = TINY_GRID.prior_grid
    range = MapTruthSettings(length_m=TINY_GRID.length_m, width_m=TINY_GRID.width_m)

    def __init__(self, root: Path) -> None:
        self._map = cache(lambda city: VectorMap.read(root / "maps" / "expansion" / f"{city}.json"))
        self._lines: dict[str, MapLines] = {}

    def lines(self, keyframe: Keyframe) -> MapLines:
        """The true lines, ego metres."""
        if keyframe.token not in self._lines:
            self._lines[keyframe.token] = self._map(keyframe.city).lines(keyframe.world_from_ego, self.range)
        return self._lines[keyframe.token]

    def truth(self, model: Any, keyframe: Keyframe) -> Any:
        return model.truth_of(self.lines(keyframe))

    def scorer(self, model: Any) -> Scorer:
        if isinstance(model, RasterMapper):
            return MaskScorer(self, model.settings)
        return LineScorer(self)


class MaskScorer(Scorer):
    """Intersection over union of masks."""

    def __init__(self, task: MapTask, settings: RasterMapperSettings) -> None:
        self._task, self._settings, self._scores = task, settings, RasterIou()

    def true_masks(self, keyframe: Keyframe) -> NDArray[np.bool_]:
        """Masks (classes, height, width)."""
        return rasterise(self._task.lines(keyframe), self._task.range, self._settings.raster).astype(np.bool_)

    def add(self, found: NDArray[np.bool_], keyframe: Keyframe) -> None:
        self._scores.add(found, self.true_masks(keyframe))

    def result(self) -> Figures:
        return _percent(self._scores.result())


class LineScorer(Scorer):
    """Average precision of lines by Chamfer distance."""

    def __init__(self, task: MapTask) -> None:
        self._task = task
        self._scores = VectorPrecision(VectorSettings.for_range(task.range.length_m, task.range.width_m))

    def add(self, found: ScoredLines, keyframe: Keyframe) -> None:
        self._scores.add(found, self._task.lines(keyframe))

    def result(self) -> Figures:
        return _percent(self._scores.result())


def _percent(scores: RasterScores | VectorScores) -> Figures:
    return {name: 100 * value for name, value in {"mean": scores.mean, **scores.per_class}.items()}


class OccupancyTask(Task):
    """Classes of voxels, 20 m around, of those that a camera saw; from this keyframe's images and those before."""

    def __init__(self, locations: Locations) -> None:
        self._root, self._size = locations.data, locations.image_size
        self.prior_grid = BevDetOccSettings.tiny().prior_grid

    def occupancy(self, keyframe: Keyframe) -> OccupancyTruth:
        """Occ3D's truth, all of its range."""
        return read_occupancy(self._root, keyframe.scene, keyframe.token)

    def truth(self, model: OccupancyModel, keyframe: Keyframe) -> Any:
        return model.truth_of(self.occupancy(keyframe), lidar_depth(keyframe, self._size))

    def more_inputs(self, keyframes: Sequence[Keyframe], material: Material) -> dict[str, Any]:
        earlier = [material.earlier(keyframe) for keyframe in keyframes]
        now, past = ([keyframe.world_from_ego for keyframe in each] for each in (keyframes, earlier))
        past_from_now = torch.from_numpy(np.linalg.inv(past) @ np.stack(now)).float()
        age_s = torch.tensor([(b.timestamp_us - a.timestamp_us) / 1e6 for a, b in zip(earlier, keyframes, strict=True)])
        return {"history": [PastFrame(past_from_now, age_s, *material.online(earlier))]}

    def scorer(self, model: OccupancyModel) -> Scorer:
        return VoxelScorer(self, model)


class VoxelScorer(Scorer):
    """Mean intersection over union of the voxels' classes."""

    def __init__(self, task: OccupancyTask, model: OccupancyModel) -> None:
        self._task, self._model, self._scores = task, model, OccupancyIou()

    def add(self, found: NDArray[np.uint8], keyframe: Keyframe) -> None:
        self._scores.add(found, self._model.in_range(self._task.occupancy(keyframe)))

    def result(self) -> Figures:
        scores = self._scores.result()
        means, classes = scores.summary(), scores.per_class
        figures = {"mean": means["overall"], "static": means["static"], "dynamic": means["dynamic"], **classes}
        return {name: 100 * value for name, value in figures.items() if not np.isnan(value)}
