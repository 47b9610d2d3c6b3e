"""Fusing a prior's voxels into a model's bird's-eye-view or 3D features (the paper, section 4.4).

Plain modules with the layer names of the released ones: their weights load with `load_state_dict`.
A batch's voxels come as one list with a sample number each, so that nothing depends on the batch size.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from presight_core.errors import InputError
from presight_perception.voxelise import MAPPING_GRID, OCCUPANCY_GRID, VoxelGrid

DROPOUT = 0.1  # as released
SLICE_VOXELS = 4  # height of the slices that PriorFusion2D pools: 2 m of voxels of 0.5 m


@dataclass(frozen=True)
class Fusion2DSettings:
    """Sizes of `PriorFusion2D`; the defaults are StreamMapNet's."""

    grid: VoxelGrid = MAPPING_GRID
    voxel_channels: int = 68  # 4 without features
    hidden_channels: int = 64
    bev_channels: int = 256
    residual: bool = False  # as released


@dataclass(frozen=True)
class Fusion3DSettings:
    """Sizes of `PriorFusion3D`; the defaults are BEVDet-Occ's. FB-OCC's: bev_channels 80, heights 8."""

    grid: VoxelGrid = OCCUPANCY_GRID
    voxel_channels: int = 68
    hidden_channels: int = 64
    flat_channels: int = 256  # of the flattened prior; divisible by heights
    bev_channels: int = 64
    heights: int = 16  # Z of the features to fuse into
    residual: bool = True  # as released


class PriorFusion2D(nn.Module):
    """Fuses a prior into BEV features: voxels to a dense grid, slices of four voxels pooled, then convolutions."""

    def __init__(self, settings: Fusion2DSettings | None = None) -> None:
        super().__init__()
        self.settings = settings = settings or Fusion2DSettings()
        hidden, channels = settings.hidden_channels, settings.bev_channels
        self.voxel_feature_extractor = _voxel_layers(settings.voxel_channels, hidden)
        self.block1 = _flat_layers(hidden * (settings.grid.shape[2] // SLICE_VOXELS), hidden)
        self.block2 = nn.Sequential(
            nn.Conv2d(channels + hidden, channels, 1),
            nn.BatchNorm2d(channels),
            nn.ReLU(),
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.BatchNorm2d(channels),
        )
        self.apply(_initialise)

    def forward(self, bev: Tensor, voxels: Tensor, coordinates: Tensor) -> Tensor:
        """Fused features of `bev` (B, channels, H, W), row 0 on the right (least y), column 0 behind (least x).

        voxels (V, voxel_channels) of the whole batch; coordinates (V, 4) int64: sample, x, y, z.
        """
        slices = _slices(self.voxel_feature_extractor(voxels), coordinates, bev.shape[0], self.settings.grid)
        flat = self.block1(slices.permute(0, 4, 3, 1, 2).flatten(1, 2))  # a channel's slices side by side
        prior = functional.interpolate(flat, bev.shape[-2:], mode="bilinear", align_corners=False)
        fused = self.block2(torch.cat([bev, prior], 1))
        return torch.relu(fused + bev if self.settings.residual else fused)


class PriorFusion3D(nn.Module):
    """Fuses a prior into voxel features: heights become channels, flat convolutions, and back."""

    def __init__(self, settings: Fusion3DSettings | None = None) -> None:
        """Raises InputError for flat_channels that cannot be cut into the heights."""
        super().__init__()
        self.settings = settings = settings or Fusion3DSettings()
        if settings.flat_channels % settings.heights:
            raise InputError(
                f"flat_channels {settings.flat_channels} cannot be cut into {settings.heights} heights; take a multiple"
            )
        hidden, channels = settings.hidden_channels, settings.bev_channels
        self.voxel_feature_extractor = _voxel_layers(settings.voxel_channels, hidden)
        self.block1 = _flat_layers(hidden * settings.grid.shape[2], settings.flat_channels)
        self.block2 = nn.Sequential(
            nn.Conv3d(settings.flat_channels // settings.heights + channels, channels, 1), nn.BatchNorm3d(channels)
        )
        self.apply(_initialise)

    def forward(self, bev: Tensor, voxels: Tensor, coordinates: Tensor) -> Tensor:
        """Fused features of `bev` (B, channels, H, W, Z), rows along y and columns along x, both ascending.

        voxels (V, voxel_channels) of the whole batch; coordinates (V, 4) int64: sample, x, y, z.
        """
        dense = _dense(self.voxel_feature_extractor(voxels), coordinates, bev.shape[0], self.settings.grid)
        flat = self.block1(dense.permute(0, 4, 3, 1, 2).flatten(1, 2))  # a channel's heights side by side
        flat = functional.max_pool2d(flat, 2)
        flat = functional.interpolate(flat, bev.shape[2:4], mode="bilinear", align_corners=True)  # exact if sizes agree
        prior = flat.unflatten(1, (-1, self.settings.heights)).permute(0, 1, 3, 4, 2)
        fused = self.block2(torch.cat([bev, prior], 1))
        return torch.relu(fused + bev if self.settings.residual else fused)


def _slices(features: Tensor, coordinates: Tensor, sample_count: int, grid: VoxelGrid) -> Tensor:
    """The greatest features (B, Y, X, Z / 4, C) of the voxels (V, C), none negative, in slices; zeros without any.

    Straight from the voxels: through a dense grid of them it takes three times as long.
    """
    x_count, y_count, z_count = grid.shape
    slice_count = z_count // SLICE_VOXELS  # voxels above the last whole slice are left out, as released
    sample, x, y, z = coordinates.unbind(1)
    row = ((sample * y_count + y) * x_count + x) * slice_count + (z // SLICE_VOXELS).clamp(max=slice_count - 1)
    features = features * (z < slice_count * SLICE_VOXELS).unsqueeze(1)
    empty = features.new_zeros(sample_count * y_count * x_count * slice_count, features.shape[1])
    slices = empty.scatter_reduce(0, row.unsqueeze(1).expand_as(features), features, "amax")
    return slices.view(sample_count, y_count, x_count, slice_count, -1)


def _dense(features: Tensor, coordinates: Tensor, sample_count: int, grid: VoxelGrid) -> Tensor:
    """Features (B, Y, X, Z, C) of a batch's voxels (V, C); zeros where there is none."""
    x_count, y_count, z_count = grid.shape
    sample, x, y, z = coordinates.unbind(1)
    row = ((sample * y_count + y) * x_count + x) * z_count + z
    dense = features.new_zeros(sample_count * y_count * x_count * z_count, features.shape[1])
    return dense.index_copy(0, row, features).view(sample_count, y_count, x_count, z_count, -1)


def _voxel_layers(inputs: int, hidden: int) -> nn.Sequential:
    first = [nn.Linear(inputs, hidden), nn.ReLU(), nn.Dropout(DROPOUT)]
    return nn.Sequential(*first, nn.Linear(hidden, hidden), nn.ReLU(), nn.Dropout(DROPOUT))


def _flat_layers(inputs: int, outputs: int) -> nn.Sequential:
    first = [nn.Conv2d(inputs, outputs, 1), nn.BatchNorm2d(outputs), nn.ReLU()]
    return nn.Sequential(*first, nn.Conv2d(outputs, outputs, 3, padding=1), nn.BatchNorm2d(outputs), nn.ReLU())


def _initialise(layer: nn.Module) -> None:
    """The released initialisation; batch norms start as the identity by themselves."""
    if isinstance(layer, nn.Conv2d | nn.Conv3d):
        nn.init.kaiming_normal_(layer.weight, mode="fan_out", nonlinearity="relu")
    elif isinstance(layer, nn.Linear):
        nn.init.xavier_uniform_(layer.weight)
    if isinstance(layer, nn.Conv2d | nn.Conv3d | nn.Linear) and layer.bias is not None:
        nn.init.zeros_(layer.bias)
