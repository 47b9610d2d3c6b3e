"""BEVDet-Occ: depth-lifted voxels of two frames, a 3D ResNet, a class for every voxel (Huang and Huang, 2022).

The same as BEVDet's `bevdet-occ-r50-4d-stereo-24e`: sizes, camera-aware depth, the earlier frame lifted straight into
the present grid and without gradients, the prior fused between frames and 3D encoder, both losses.
Simplified: no stereo cost volume (depth comes from one image). Corrected: points lie in the middle of depth bins and
feature pixels, where the original takes the nearer edge and the outermost pixels' centres.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from presight_perception.models.backbone import ImageEncoder
from presight_perception.models.bev_features import Sources
from presight_perception.models.camera_rig import CameraRig
from presight_perception.models.lift_splat import DepthBins, LiftSettings, LiftSplat
from presight_perception.models.occ_blocks import LssPyramid3D, ResNet3D, ResNet3DSettings, SubvoxelHead
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
from presight_perception.models.occ_losses import cross_entropy_loss
from presight_perception.models.occ_model import (
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
class BevDetOccSettings(OccupancySettings):
    """Sizes and weights of `BevDetOcc`; the defaults are the published ones."""

    lift: LiftSettings = field(default_factory=LiftSettings)
    channels: tuple[int, ...] = (32, 64, 128)  # of the 3D ResNet
    blocks: tuple[int, ...] = (1, 2, 4)
    subdivision: int = 1  # predicted voxels along a side of the grid's
    depth_weight: float = 0.05
    rarity: float = 0.0  # a class weighs 1 / (its voxels in nuScenes) ** rarity, free space 1; not in the original

    @staticmethod
    def paper(sources: Sources | None = None) -> "BevDetOccSettings":
        """The published sizes."""
        return BevDetOccSettings(sources or Sources())

    @staticmethod
    def tiny(sources: Sources | None = None, grid: VoxelGrid = NEAR_GRID) -> "BevDetOccSettings":
        """Trains on two processor cores: 20 m around, in voxels of 0.8 m that predict 2 x 2 x 2 classes each."""
        return BevDetOccSettings(
            sources or Sources(),
            TINY_RESNET,
            grid,
            prior_hidden=16,
            prior_flat=64,
            lift=LiftSettings(64, 32, context=16, bins=DepthBins(step_m=1.0), aspp_width=16),
            channels=(16, 24, 32),
            blocks=(1, 1, 1),
            subdivision=2,
            rarity=0.5,  # or a short training finds nothing but ground and air
        )


class BevDetOcc(OccupancyModel):
    """BEVDet-Occ."""

    class_weights: Tensor

    def __init__(self, settings: BevDetOccSettings | None = None) -> None:
        self.settings = settings = settings or BevDetOccSettings()
        context, frame_count = settings.lift.context, 1 + settings.earlier_frames
        super().__init__(settings, context * frame_count)
        if settings.sources.cameras:
            self.image_encoder = ImageEncoder(settings.images)
            self.lift = LiftSplat(settings.lift, settings.grid)
            own_encoder = ResNet3D(ResNet3DSettings(context, (context,), (1,), (1,)))
            self.own_encoder = own_encoder if frame_count > 1 else None  # as released
        strides = (1,) + (2,) * (len(settings.channels) - 1)
        self.encoder = ResNet3D(ResNet3DSettings(self.channels, settings.channels, settings.blocks, strides))
        self.neck = LssPyramid3D(settings.channels, context)
        self.head = SubvoxelHead(context, CLASS_COUNT, settings.subdivision)
        counts = torch.tensor(NUSCENES_VOXELS, dtype=torch.float32)
        self.register_buffer("class_weights", (counts[FREE] / counts) ** settings.rarity, persistent=False)

    def see(self, images: Tensor, rig: CameraRig, history: Sequence[PastFrame]) -> OnlineVoxels:
        """Voxels of this frame and the earlier ones side by side."""
        own, depth = self._frame(images, rig, None)
        frames = [own]
        for number in range(self.settings.earlier_frames):
            frames.append(self._earlier(history[number]) if number < len(history) else own.detach())
        return OnlineVoxels(torch.cat(frames, 1), own, depth)

    def classify(self, voxels: Tensor) -> Tensor:
        return self.head(self.neck(self.encoder(voxels)))

    def loss(self, predictions: OccupancyPredictions, truths: Sequence[OccupancyTarget]) -> dict[str, Tensor]:
        """Cross-entropy of the voxels that a camera saw, and of depth where the truth has it."""
        known, classes = known_voxels(predictions.logits, truths)
        parts = {"classes": cross_entropy_loss(predictions.logits[known], classes, self.class_weights)}
        depth = lidar_loss(predictions.depth, truths, self.settings.lift.bins)
        return parts if depth is None else {**parts, "depth": self.settings.depth_weight * depth}

    def _frame(self, images: Tensor, rig: CameraRig, now_from_past: Tensor | None) -> tuple[Tensor, Tensor]:
        """Voxels of one frame around the vehicle now, and depth."""
        voxels, _, depth = self.lift(self.image_encoder(images)[0], rig, image_size(images), now_from_past)
        return (voxels if self.own_encoder is None else self.own_encoder(voxels)[-1]), depth

    @torch.no_grad()
    def _earlier(self, frame: PastFrame) -> Tensor:
        if frame.voxels is not None:
            return aligned(frame.voxels, frame.past_from_now, self.settings.grid)
        return self._frame(*frame.seen(), frame.past_from_now.inverse())[0]
