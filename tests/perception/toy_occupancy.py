"""Occupancy models, truth and a prior of 12.8 x 12.8 x 3.2 m, for tests."""

from dataclasses import replace

import numpy as np
import torch

from presight_perception.dataset import PriorBatch
from presight_perception.models.bev_features import Sources
from presight_perception.models.bevdet_occ import BevDetOcc, BevDetOccSettings
from presight_perception.models.fb_occ import FbOcc, FbOccSettings
from presight_perception.models.lift_splat import DepthBins
from presight_perception.models.occ_frames import PastFrame
from presight_perception.models.occ_model import OccupancyModel
from presight_perception.occupancy_truth import OccupancyTruth
from presight_perception.voxelise import VoxelGrid
from tests.perception import toy_rig

GRID = VoxelGrid((-6.4, -6.4, -1.0), (6.4, 6.4, 2.2), (0.8, 0.8, 0.8))  # 16 x 16 x 4 voxels
BINS = DepthBins(1.0, 11.0, 1.0)
MODELS = {"bevdet": (BevDetOcc, BevDetOccSettings), "fb": (FbOcc, FbOccSettings)}
CAMERAS, BOTH, PRIOR = Sources(), Sources(prior_channels=6), Sources(cameras=False, prior_channels=6)


def model(name: str, sources: Sources = BOTH, earlier_frames: int = 1) -> OccupancyModel:
    """A tiny model on the toy grid."""
    torch.manual_seed(0)
    kind, settings = MODELS[name]
    tiny = settings.tiny(sources, GRID)
    return kind(replace(tiny, lift=replace(tiny.lift, bins=BINS), earlier_frames=earlier_frames))


def prior(batch: int = 2, voxel_count: int = 400) -> PriorBatch:
    random = torch.Generator().manual_seed(4)
    shape = (batch, 32, 32, 20)  # of the prior's voxels
    rows = torch.randperm(int(np.prod(shape)), generator=random)[:voxel_count].numpy()
    coordinates = torch.from_numpy(np.stack(np.unravel_index(rows, shape), -1))
    return PriorBatch(torch.randn(voxel_count, 6, generator=random), coordinates, torch.eye(3).repeat(batch, 1, 1))


def truths(batch: int = 2) -> list[OccupancyTruth]:
    """Occ3D's range: a road, and a wall on the left of the first sample and on the right of the second."""
    found = []
    for number in range(batch):
        semantics = np.full((200, 200, 16), 17, np.uint8)
        semantics[:, :, 1] = 11
        semantics[:, 108:112, 2:6] = 15  # 3.2 to 4.8 m left of the vehicle
        mask = np.random.default_rng(number).random((200, 200, 16)) < 0.7
        found.append(OccupancyTruth(semantics if number % 2 == 0 else semantics[:, ::-1].copy(), mask, mask))
    return found


def earlier(batch: int = 2, voxels: torch.Tensor | None = None) -> PastFrame:
    """Half a second ago, 2 m behind, of other images."""
    past_from_now = torch.eye(4).repeat(batch, 1, 1)
    past_from_now[:, 0, 3] = 2.0
    images = toy_rig.pictures(batch).flip(-1)
    return PastFrame(past_from_now, torch.full((batch,), 0.5), images, toy_rig.rig(batch), voxels)
