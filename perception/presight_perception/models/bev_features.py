"""What the three map models share: bird's-eye-view features from cameras, from a prior, or from both."""

from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from presight_core.errors import InputError, SettingsError
from presight_perception.dataset import PriorBatch
from presight_perception.fusion import Fusion2DSettings, PriorFusion2D
from presight_perception.models.backbone import ImageEncoder, ImageEncoderSettings, ResNetSettings
from presight_perception.models.bev_grid import BevGrid
from presight_perception.models.camera_rig import CameraRig
from presight_perception.models.view_transform import BevFormer, BevFormerSettings, BilinearLift, LiftSettings

# Made to be loaded with ImageNet's weights.
RESNET_50 = ImageEncoderSettings(ResNetSettings(50, norm_eval=True, deformable_stages=(3, 4)))


@dataclass(frozen=True)
class Sources:
    """What a model perceives with."""

    cameras: bool = True  # False: a model without cameras, trained on the prior alone (Table 7, setting b)
    prior_channels: int | None = None  # of a prior's voxel: 68 as released, 4 without features; None: no prior


@dataclass(frozen=True)
class BevSettings:
    """From images to bird's-eye-view features; the defaults are StreamMapNet's."""

    grid: BevGrid = field(default_factory=BevGrid)
    channels: int = 256
    sources: Sources = field(default_factory=Sources)
    images: ImageEncoderSettings = RESNET_50
    view: BevFormerSettings | LiftSettings = field(default_factory=BevFormerSettings)
    camera_count: int = 6
    prior_hidden: int = 64  # channels inside the fusion

    def __post_init__(self) -> None:
        """Raises SettingsError for settings that do not fit each other."""
        if not self.sources.cameras and self.sources.prior_channels is None:
            raise SettingsError("a model needs cameras or a prior; set sources.cameras or sources.prior_channels")
        if isinstance(self.view, BevFormerSettings) and self.images.channels != self.channels:
            raise SettingsError(
                f"BEVFormer looks with cells of {self.channels} channels into images of {self.images.channels}; "
                "give both as many"
            )

    @staticmethod
    def tiny(sources: Sources, grid: BevGrid) -> "BevSettings":
        """A bilinear lift of a narrow ResNet-10's features, for training on two processor cores."""
        images = ImageEncoderSettings(ResNetSettings(depth=10, width=16, stages=(1, 2, 3)), 32, output_count=1)
        return BevSettings(grid, 64, sources, images, LiftSettings(), prior_hidden=32)

    @property
    def fusion(self) -> Fusion2DSettings | None:
        """The prior's fusion, over the same rectangle."""
        if self.sources.prior_channels is None:
            return None
        return Fusion2DSettings(self.grid.prior_grid, self.sources.prior_channels, self.prior_hidden, self.channels)


TINY_GRID = BevGrid(60.0, 30.0, 30, 60)  # the paper's smaller range in cells of 1 m


class BevFeatures(nn.Module):
    """Features (B, channels, rows, columns); row 0 is on the right (least y), column 0 behind (least x)."""

    def __init__(self, settings: BevSettings) -> None:
        super().__init__()
        self.settings = settings
        self.encoder = ImageEncoder(settings.images) if settings.sources.cameras else None
        self.view = _view(settings) if settings.sources.cameras else None
        self.fusion = PriorFusion2D(settings.fusion) if settings.fusion else None

    def forward(self, images: Tensor | None, rig: CameraRig | None, prior: PriorBatch | None) -> Tensor:
        """Features of images (B, N, 3, H, W), RGB 0..1, and a prior's voxels.

        Without images the online features are zeros: in a model with cameras, that is Table 7's setting a.
        Without a prior, a model that has its fusion gets no voxel. Raises InputError if there is neither.
        """
        if prior is not None and self.fusion is None:
            raise InputError("a prior is given to a model without prior; set sources.prior_channels")
        bev = self._online(images, rig, prior)
        if self.fusion is None:
            return bev
        if prior is None:
            voxels = bev.new_zeros(0, self.fusion.settings.voxel_channels)
            return self.fusion(bev, voxels, torch.zeros(0, 4, dtype=torch.int64, device=bev.device))
        return self.fusion(bev, prior.voxels, prior.coordinates)

    def _online(self, images: Tensor | None, rig: CameraRig | None, prior: PriorBatch | None) -> Tensor:
        if images is not None and rig is not None and self.encoder is not None and self.view is not None:
            levels = self.encoder(images)
            return self.view(levels, rig, (images.shape[-2], images.shape[-1]))
        if prior is None:
            raise InputError("neither images with their rig nor a prior are given; give one of them")
        settings = self.settings
        shape = (len(prior.augmentations), settings.channels, settings.grid.rows, settings.grid.columns)
        return prior.voxels.new_zeros(shape)


def _view(settings: BevSettings) -> BevFormer | BilinearLift:
    if isinstance(settings.view, LiftSettings):
        return BilinearLift(settings.view, settings.grid, (settings.images.channels, settings.channels))
    images = settings.images
    levels = len(images.resnet.stages) if images.output_count is None else images.output_count
    return BevFormer(settings.view, settings.grid, settings.channels, (settings.camera_count, levels))
