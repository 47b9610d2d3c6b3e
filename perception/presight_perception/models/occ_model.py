"""The one interface of the occupancy models: online voxels from cameras, a prior fused into them, logits out."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from presight_core.errors import InputError, SettingsError
from presight_perception.dataset import PriorBatch
from presight_perception.fusion import Fusion3DSettings, PriorFusion3D
from presight_perception.models.backbone import ImageEncoderSettings, ResNetSettings
from presight_perception.models.bev_features import Sources
from presight_perception.models.camera_rig import CameraRig
from presight_perception.models.lift_splat import Size
from presight_perception.models.occ_frames import OccupancyPredictions, OccupancyTarget, PastFrame, within
from presight_perception.occupancy_truth import RANGE_HIGH_M, RANGE_LOW_M, OccupancyTruth
from presight_perception.voxelise import OCCUPANCY_GRID, VoxelGrid

FULL_GRID = VoxelGrid(RANGE_LOW_M, RANGE_HIGH_M, (0.4, 0.4, 0.4))  # 200 x 200 x 16, Occ3D's own
HALF_GRID = VoxelGrid(RANGE_LOW_M, RANGE_HIGH_M, (0.8, 0.8, 0.8))  # 100 x 100 x 8
NEAR_GRID = VoxelGrid((-20.0, -20.0, -1.0), (20.0, 20.0, 5.4), (0.8, 0.8, 0.8))  # 50 x 50 x 8: a quarter of the work
RESNET_50 = ImageEncoderSettings(ResNetSettings(50, stages=(3, 4)), 256, output_count=1)  # stride 16 alone
TINY_RESNET = ImageEncoderSettings(ResNetSettings(10, width=16, stages=(2, 3)), 64, output_count=1)  # stride 8


@dataclass(frozen=True)
class OccupancySettings:
    """What both models set; the defaults are BEVDet-Occ's."""

    sources: Sources = field(default_factory=Sources)
    images: ImageEncoderSettings = RESNET_50
    grid: VoxelGrid = FULL_GRID  # of the voxels that the prior is fused into
    earlier_frames: int = 1
    prior_hidden: int = 64  # channels inside the fusion
    prior_flat: int = 256  # the same, of the flattened prior

    @property
    def prior_grid(self) -> VoxelGrid:
        """The released voxels of a prior, over the same rectangle."""
        (x_low, y_low, _), (x_high, y_high, _) = self.grid.low_m, self.grid.high_m
        released = OCCUPANCY_GRID
        low, high = (x_low, y_low, released.low_m[2]), (x_high, y_high, released.high_m[2])
        return VoxelGrid(low, high, released.voxel_m)


@dataclass(frozen=True)
class OnlineVoxels:
    """What the cameras see."""

    fused: Tensor  # (B, channels, Z, Y, X) with history
    own: Tensor  # (B, C, Z, Y, X) of this frame alone
    depth: Tensor  # (B, N, D, h, w)


class OccupancyModel(nn.Module, ABC):
    """Semantic occupancy around a vehicle, from images, earlier frames and a prior."""

    def __init__(self, settings: OccupancySettings, channels: int) -> None:
        """`channels` are those of the online voxels. Raises SettingsError for a model with neither source."""
        super().__init__()
        self.common, self.channels, sources = settings, channels, settings.sources
        if not (sources.cameras or sources.prior_channels):
            raise SettingsError("a model needs cameras or a prior; set sources.cameras or sources.prior_channels")
        self.fusion = _fusion(settings, channels)

    def forward(
        self,
        images: Tensor | None,
        rig: CameraRig | None,
        prior: PriorBatch | None = None,
        history: Sequence[PastFrame] = (),
    ) -> OccupancyPredictions:
        """Logits of every voxel, from images (B, N, 3, H, W), RGB 0..1, their rig, and earlier frames, newest first.

        Earlier frames that are missing are taken to look as now. Without images the online voxels are zeros: in a model
        with cameras that is Table 7's setting a. Without a prior, a model that has its fusion gets no voxel.
        Raises InputError if there is neither, or a prior that the model has no use for.
        """
        if prior is not None and self.fusion is None:
            raise InputError("a prior is given to a model without prior; set sources.prior_channels")
        online = None
        if self.common.sources.cameras and images is not None and rig is not None:
            online = self.see(images, rig, history)
        voxels = self._zeros(prior) if online is None else online.fused
        logits = self.classify(voxels if self.fusion is None else self._fused(self.fusion, voxels, prior))
        if online is None:
            return OccupancyPredictions(logits, None, None)
        return OccupancyPredictions(logits, online.depth, online.own.detach())

    @abstractmethod
    def see(self, images: Tensor, rig: CameraRig, history: Sequence[PastFrame]) -> OnlineVoxels:
        """Voxels from cameras, with earlier frames."""

    @abstractmethod
    def classify(self, voxels: Tensor) -> Tensor:
        """Logits (B, X, Y, Z, 18) of fused voxels (B, channels, Z, Y, X)."""

    @abstractmethod
    def loss(self, predictions: OccupancyPredictions, truths: Sequence[OccupancyTarget]) -> dict[str, Tensor]:
        """The weighted parts of the loss, each a number; train on their sum."""

    def truth_of(self, truth: OccupancyTruth, depth_m: Tensor | None = None) -> OccupancyTarget:
        """One sample's truth, of all of Occ3D's range, as `loss` wants it; depth_m as in `OccupancyTarget`."""
        return OccupancyTarget.of(self.in_range(truth), depth_m)

    def in_range(self, truth: OccupancyTruth) -> OccupancyTruth:
        """The voxels of Occ3D's truth that the model predicts: what its predictions are to be scored by."""
        return within(truth, self.common.grid)

    def decode(self, predictions: OccupancyPredictions) -> list[NDArray[np.uint8]]:
        """Of each sample, the likeliest class (X, Y, Z) of every voxel, in Occ3D's layout, as the metric takes it."""
        return list(predictions.logits.argmax(-1).to(torch.uint8).cpu().numpy())

    def _fused(self, fusion: PriorFusion3D, voxels: Tensor, prior: PriorBatch | None) -> Tensor:
        features = voxels.new_zeros(0, fusion.settings.voxel_channels) if prior is None else prior.voxels
        none = torch.zeros(0, 4, dtype=torch.int64, device=voxels.device)
        fused = fusion(voxels.permute(0, 1, 3, 4, 2), features, none if prior is None else prior.coordinates)
        return fused.permute(0, 1, 4, 2, 3)

    def _zeros(self, prior: PriorBatch | None) -> Tensor:
        if prior is None:
            raise InputError("neither images with their rig nor a prior are given; give one of them")
        x, y, z = self.common.grid.shape
        return prior.voxels.new_zeros(len(prior.augmentations), self.channels, z, y, x)


def image_size(images: Tensor) -> Size:
    """Height and width in pixels."""
    return images.shape[-2], images.shape[-1]


def _fusion(settings: OccupancySettings, channels: int) -> PriorFusion3D | None:
    if settings.sources.prior_channels is None:
        return None
    widths = (settings.sources.prior_channels, settings.prior_hidden, settings.prior_flat)
    return PriorFusion3D(Fusion3DSettings(settings.prior_grid, *widths, channels, settings.grid.shape[2]))
