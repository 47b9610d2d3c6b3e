"""Neural Map Prior at work: a map of the model's own features, read before and written after each sample."""

from collections.abc import Sequence

import torch
from torch import Tensor

from presight_perception.experiment.keyframes import Keyframe
from presight_perception.experiment.material import Material
from presight_perception.models.camera_rig import CameraRig
from presight_perception.models.nmp_raster_mapper import NmpRasterMapper
from presight_perception.neural_map_prior import NeuralMap


class MapMemory:
    """A model and what it remembers of the cities."""

    def __init__(self, model: NmpRasterMapper) -> None:
        self._model = model
        self._map = NeuralMap(model.prior_settings)

    def clear(self) -> None:
        """Forget all: before each epoch."""
        self._map.clear()

    def predict(self, images: Tensor, rig: CameraRig, keyframes: Sequence[Keyframe], remember: bool) -> Tensor:
        """The model's predictions of some keyframes with what it remembers of their places."""
        prior = torch.stack([self._map.read(keyframe.city, keyframe.world_from_ego) for keyframe in keyframes])
        fused = self._model.fused(images, rig, prior)
        if remember:
            for keyframe, features in zip(keyframes, fused.detach(), strict=True):
                self._map.write(keyframe.city, keyframe.world_from_ego, features)
        return self._model.predict(fused)

    def drive(self, keyframes: Sequence[Keyframe], material: Material) -> None:
        """Fill the map by driving past keyframes, one after the other."""
        with torch.inference_mode():
            for keyframe in keyframes:
                self.predict(*material.online([keyframe]), [keyframe], remember=True)
