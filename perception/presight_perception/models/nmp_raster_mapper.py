"""The raster map model with Neural Map Prior in the place of voxels."""

from dataclasses import replace

import torch
from torch import Tensor

from presight_core.errors import InputError, SettingsError
from presight_perception.dataset import PriorBatch
from presight_perception.models.camera_rig import CameraRig
from presight_perception.models.raster_mapper import RasterMapper, RasterMapperSettings
from presight_perception.neural_map_prior import MapPriorFusion, NeuralMapSettings


class NmpRasterMapper(RasterMapper):
    """`RasterMapper` whose prior is a tensor (B, channels, rows, columns) of what `NeuralMap` read.

    `fused` gives the features that are to be decoded and written back.
    """

    def __init__(self, settings: RasterMapperSettings | None = None, prior: NeuralMapSettings | None = None) -> None:
        """The prior's grid and channels are those of the model's bird's-eye view, whatever `prior` says.

        Raises SettingsError for a model that has voxels too, or for windows that do not fit the grid.
        """
        super().__init__(settings)
        bev = self.settings.bev
        if bev.sources.prior_channels is not None:
            raise SettingsError("this model has no voxels; leave sources.prior_channels out")
        self.prior_settings = replace(prior or NeuralMapSettings(), grid=bev.grid, channels=bev.channels)
        self.fusion = MapPriorFusion(self.prior_settings)

    def forward(self, images: Tensor | None, rig: CameraRig | None, prior: PriorBatch | Tensor | None = None) -> Tensor:
        """Logits; without a prior, the map is empty. Raises InputError for voxels."""
        if isinstance(prior, PriorBatch):
            raise InputError("this model's prior is what NeuralMap reads, not voxels; give a tensor")
        return self.predict(self.fused(images, rig, prior))

    def fused(self, images: Tensor | None, rig: CameraRig | None, prior: Tensor | None) -> Tensor:
        """Features (B, channels, rows, columns) of images and prior."""
        bev = self.bev(images, rig, None)
        return self.fusion(bev, torch.zeros_like(bev) if prior is None else prior.to(bev))
