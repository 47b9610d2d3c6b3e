"""FB-OCC: voxels lifted forward and BEV cells looking backward, a long history, a 3D encoder (Li et al., 2023).

The same as `fbocc-r50-cbgs_depth_16f_16x4_20e`: sizes, forward and backward projection, readding, the two layers that
fuse history, encoder, pyramid, head, all losses. The prior is fused between history and encoder.
Simplified: no void logit, whose class has no voxels; history is warped from each earlier frame at once rather than
again at every step, which blurs less; the image encoder's pretraining for depth is the user's.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from presight_perception.models.backbone import ImageEncoder
from presight_perception.models.bev_features import Sources
from presight_perception.models.camera_rig import CameraRig
from presight_perception.models.fb_projection import BackwardProjection, BackwardSettings, Views
from presight_perception.models.lift_splat import DepthBins, LiftSettings, LiftSplat
from presight_perception.models.occ_blocks import (
    FeaturePyramid3D,
    LevelMixHead,
    ResNet3D,
    ResNet3DSettings,
    convolution_3d,
)
from presight_perception.models.occ_frames import (
    CLASS_COUNT,
    NUSCENES_VOXELS,
    OccupancyPredictions,
    OccupancyTarget,
    PastFrame,
    aligned,
    known_voxels,
    lidar_loss,
)
from presight_perception.models.occ_losses import (
    focal_loss,
    geometric_affinity_loss,
    lovasz_loss,
    semantic_affinity_loss,
)
from presight_perception.models.occ_model import (
    HALF_GRID,
    NEAR_GRID,
    TINY_RESNET,
    OccupancyModel,
    OccupancySettings,
    OnlineVoxels,
    image_size,
)
from presight_perception.occupancy_truth import FREE
from presight_perception.voxelise import VoxelGrid


@dataclass(frozen=True)
class FbOccSettings(OccupancySettings):
    """Sizes and weights of `FbOcc`; the defaults are the published ones."""

    grid: VoxelGrid = HALF_GRID  # the predicted voxels are half as large
    earlier_frames: int = 16
    lift: LiftSettings = field(
        default_factory=lambda: LiftSettings(width=512, context=80, bins=DepthBins(2.0, 42.0), aspp_width=512)
    )
    backward: BackwardSettings = field(default_factory=BackwardSettings)
    channels: tuple[int, ...] = (64, 128, 256)  # of the 3D ResNet-18
    blocks: tuple[int, ...] = (2, 2, 2)
    pyramid_channels: int = 256
    head_channels: tuple[int, int] = (128, 64)
    voxel_counts: tuple[int, ...] = NUSCENES_VOXELS
    focal_weight: float = 100.0
    depth_weight: float = 1.0

    @staticmethod
    def paper(sources: Sources | None = None) -> "FbOccSettings":
        """The published sizes."""
        return FbOccSettings(sources or Sources())

    @staticmethod
    def tiny(sources: Sources | None = None, grid: VoxelGrid = NEAR_GRID) -> "FbOccSettings":
        """Trains on two processor cores: 20 m around, one earlier frame."""
        return FbOccSettings(
            sources or Sources(),
            TINY_RESNET,
            grid,
            earlier_frames=1,
            prior_hidden=16,
            prior_flat=64,
            lift=LiftSettings(64, 32, context=16, bins=DepthBins(2.0, 42.0, 1.0), aspp_width=16),
            backward=BackwardSettings(16, heads=4, points=4, self_points=2, feedforward=32),
            channels=(16, 24, 32),
            blocks=(1, 1, 1),
            pyramid_channels=16,
            head_channels=(16, 16),
        )


class FbOcc(OccupancyModel):
    """FB-OCC."""

    class_weights: Tensor

    def __init__(self, settings: FbOccSettings | None = None) -> None:
        self.settings = settings = settings or FbOccSettings()
        super().__init__(settings, settings.lift.context)
        if settings.sources.cameras:
            self.image_encoder = ImageEncoder(settings.images)
            self.lift = LiftSplat(settings.lift, settings.grid)
            self.backward_projection = BackwardProjection(settings.backward, settings.grid, settings.lift.bins)
            self.history = FrameMix(self.channels, settings.earlier_frames)
        strides = (1,) + (2,) * (len(settings.channels) - 1)
        self.encoder = ResNet3D(ResNet3DSettings(self.channels, settings.channels, settings.blocks, strides, "fb"))
        self.neck = FeaturePyramid3D(settings.channels, settings.pyramid_channels)
        self.head = LevelMixHead(settings.pyramid_channels, len(settings.channels), settings.head_channels, CLASS_COUNT)
        weights = torch.tensor([1 / math.log(count) for count in settings.voxel_counts])
        self.register_buffer("class_weights", weights, persistent=False)

    def see(self, images: Tensor, rig: CameraRig, history: Sequence[PastFrame]) -> OnlineVoxels:
        """Voxels of this frame mixed with those of earlier ones."""
        own, depth = self._frame(images, rig)
        frames, ages_s = [own], [own.new_zeros(len(own))]
        for number in range(self.settings.earlier_frames):
            known = number < len(history)
            frames.append(self._earlier(history[number]) if known else own.detach())
            ages_s.append(history[number].age_s.to(own) if known else ages_s[0])
        return OnlineVoxels(self.history(torch.stack(frames, 1), torch.stack(ages_s, 1)), own, depth)

    def classify(self, voxels: Tensor) -> Tensor:
        return self.head(self.neck(self.encoder(voxels))).permute(0, 4, 3, 2, 1)

    def loss(self, predictions: OccupancyPredictions, truths: Sequence[OccupancyTarget]) -> dict[str, Tensor]:
        """Focal, Lovász, semantic and geometric affinity of the voxels that a camera saw, and depth where known."""
        known, classes = known_voxels(predictions.logits, truths)
        logits = predictions.logits[known]
        probabilities = logits.softmax(1)
        weights = _radial_weights(known)[:, None] * self.class_weights
        parts = {
            "focal": self.settings.focal_weight * focal_loss(logits, classes, weights),
            "lovasz": lovasz_loss(probabilities, classes),
            "semantic": semantic_affinity_loss(probabilities, classes, FREE),
            "geometric": geometric_affinity_loss(probabilities, classes, FREE),
        }
        depth = lidar_loss(predictions.depth, truths, self.settings.lift.bins)
        return parts if depth is None else {**parts, "depth": self.settings.depth_weight * depth}

    def _frame(self, images: Tensor, rig: CameraRig) -> tuple[Tensor, Tensor]:
        size = image_size(images)
        voxels, context, depth = self.lift(self.image_encoder(images)[0], rig, size)
        bev = self.backward_projection(voxels.mean(2), Views(context, depth, rig, size))
        return voxels + bev.unsqueeze(2), depth

    @torch.no_grad()
    def _earlier(self, frame: PastFrame) -> Tensor:
        voxels = self._frame(*frame.seen())[0] if frame.voxels is None else frame.voxels
        return aligned(voxels, frame.past_from_now, self.settings.grid)


class FrameMix(nn.Module):
    """Voxels of several frames, each told its age, mixed into one."""

    def __init__(self, channels: int, earlier_frames: int) -> None:
        super().__init__()
        self.told = convolution_3d(channels + 1, channels, 1)
        self.mix = convolution_3d(channels * (earlier_frames + 1), channels, 1)

    def forward(self, frames: Tensor, ages_s: Tensor) -> Tensor:
        """Voxels (B, C, Z, Y, X) of frames (B, frames, C, Z, Y, X) and their ages (B, frames) in seconds."""
        ages = ages_s[:, :, None, None, None, None].expand(-1, -1, 1, *frames.shape[3:])
        told = self.told(torch.cat([frames, ages], 2).flatten(0, 1))
        return self.mix(told.unflatten(0, frames.shape[:2]).flatten(1, 2))


def _radial_weights(known: Tensor) -> Tensor:
    """Weights (V,) of the known voxels, from 1 at the vehicle to 2 in the corners: the far is hard to see."""
    x, y = (torch.arange(count, device=known.device) - (count - 1) / 2 for count in known.shape[1:3])
    radius = torch.hypot(x[:, None], y)
    return (1 + radius / radius.max())[None, :, :, None].expand_as(known)[known]
