"""The raster map model: BEVFormer's encoder and HDMapNet's decoder, as released with PreSight."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from presight_perception.map_truth import MAP_CLASSES, MapLines, MapTruthSettings, RasterSettings, rasterise
from presight_perception.models.bev_features import TINY_GRID, BevSettings, Sources
from presight_perception.models.bev_grid import BevGrid
from presight_perception.models.map_model import MapModel

LEAST_AREA = 1.0  # pixels added to both sides of the dice: a class that is absent and not predicted costs nothing


@dataclass(frozen=True)
class RasterMapperSettings:
    """Sizes and loss; the defaults are the paper's."""

    bev: BevSettings = field(default_factory=BevSettings)
    hidden: int = 256  # channels of the decoder
    doublings: int = 2  # cells of 1 m become pixels of 0.25 m
    positive_weight: float = 2.13  # of the binary cross entropy, as released
    dice_weight: float = 0.0  # not in the paper; helps short trainings
    thickness_px: int = 5  # of the true lines, as released

    @staticmethod
    def paper(sources: Sources | None = None) -> "RasterMapperSettings":
        """The published sizes: ResNet-50, 100 x 50 m."""
        return RasterMapperSettings(BevSettings(sources=sources or Sources()))

    @staticmethod
    def tiny(sources: Sources | None = None, grid: BevGrid = TINY_GRID) -> "RasterMapperSettings":
        """Trains on two processor cores."""
        bev = BevSettings.tiny(sources or Sources(), grid)
        return RasterMapperSettings(bev, hidden=32, doublings=1, dice_weight=1.0, thickness_px=1)

    @property
    def raster(self) -> RasterSettings:
        """The picture that is predicted."""
        factor, grid = 2**self.doublings, self.bev.grid
        return RasterSettings(grid.rows * factor, grid.columns * factor, self.thickness_px)


class RasterMapper(MapModel[Tensor, Tensor]):
    """Predicts logits (B, classes, height, width) of the map's classes, rows and columns as the grid's."""

    def __init__(self, settings: RasterMapperSettings | None = None) -> None:
        self.settings = settings = settings or RasterMapperSettings()
        super().__init__(settings.bev)
        inputs, hidden = settings.bev.channels, settings.hidden
        layers = [_doubling(inputs, hidden), _convolution(hidden, hidden)]  # the first doubling has two convolutions
        layers += [_doubling(hidden, hidden) for _ in range(settings.doublings - 1)]
        self.decoder = nn.Sequential(*layers, nn.Conv2d(hidden, len(MAP_CLASSES), 3, padding=1))

    def predict(self, bev: Tensor) -> Tensor:
        return self.decoder(bev)

    def truth_of(self, lines: MapLines) -> Tensor:
        """Masks (classes, height, width) of bytes, 0 and 1."""
        grid = self.settings.bev.grid
        truth = MapTruthSettings(length_m=grid.length_m, width_m=grid.width_m)
        return torch.from_numpy(rasterise(lines, truth, self.settings.raster))

    def loss(self, predictions: Tensor, truths: Sequence[Tensor]) -> dict[str, Tensor]:
        masks = torch.stack(list(truths)).to(predictions)
        weight = predictions.new_tensor(self.settings.positive_weight)
        parts = {"mask": functional.binary_cross_entropy_with_logits(predictions, masks, pos_weight=weight)}
        if self.settings.dice_weight:
            parts["dice"] = self.settings.dice_weight * dice_loss(predictions, masks)
        return parts

    def decode(self, predictions: Tensor) -> list[NDArray[np.bool_]]:
        """Masks (classes, height, width): where a class is likelier than not."""
        return list((predictions > 0).cpu().numpy())


def dice_loss(logits: Tensor, masks: Tensor) -> Tensor:
    """One minus the overlap of probable and true areas over the batch, the mean of the classes."""
    shares = logits.sigmoid()
    common, total = (shares * masks).sum((0, 2, 3)), (shares + masks).sum((0, 2, 3))
    return (1 - (2 * common + LEAST_AREA) / (total + LEAST_AREA)).mean()


def _doubling(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Upsample(scale_factor=2, mode="bilinear", align_corners=True), _convolution(inputs, outputs)
    )


def _convolution(inputs: int, outputs: int) -> nn.Sequential:
    convolution = nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs), nn.ReLU())
