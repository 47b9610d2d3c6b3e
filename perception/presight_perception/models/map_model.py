"""The one interface of the map models."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, Generic, TypeVar

from torch import Tensor, nn

from presight_perception.dataset import PriorBatch
from presight_perception.map_truth import MapLines
from presight_perception.models.bev_features import BevFeatures, BevSettings
from presight_perception.models.camera_rig import CameraRig

Predictions = TypeVar("Predictions")
Truth = TypeVar("Truth")


class MapModel(nn.Module, ABC, Generic[Predictions, Truth]):
    """Online mapping of a vehicle's surroundings from one instant's images; no history, as in the paper."""

    def __init__(self, bev: BevSettings) -> None:
        super().__init__()
        self.bev = BevFeatures(bev)

    def forward(self, images: Tensor | None, rig: CameraRig | None, prior: PriorBatch | None = None) -> Predictions:
        """Predictions from images (B, N, 3, H, W), RGB 0..1, their rig, and a prior; see `BevFeatures`."""
        return self.predict(self.bev(images, rig, prior))

    @abstractmethod
    def predict(self, bev: Tensor) -> Predictions:
        """Predictions from features (B, channels, rows, columns)."""

    @abstractmethod
    def truth_of(self, lines: MapLines) -> Truth:
        """One sample's lines, ego metres, as `loss` wants them. Cheap to pickle: let data workers call it."""

    @abstractmethod
    def loss(self, predictions: Predictions, truths: Sequence[Truth]) -> dict[str, Tensor]:
        """The weighted parts of the loss, each a number; train on their sum."""

    @abstractmethod
    def decode(self, predictions: Predictions) -> Sequence[Any]:
        """Of each sample, what the metric takes: `ScoredLines`, or masks (classes, height, width) of booleans."""


def rare_class_bias(layer: nn.Linear) -> None:
    """Let a classifier begin with a probability of 0.01 for each class, as focal losses want it."""
    nn.init.constant_(layer.bias, -math.log((1 - 0.01) / 0.01))
