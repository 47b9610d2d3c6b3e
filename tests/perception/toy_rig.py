"""A rig, pictures, lines and a prior for the tests of models; as small as they can be."""

import numpy as np
import torch

from presight_perception.dataset import PriorBatch
from presight_perception.map_truth import MapLines
from presight_perception.models.bev_grid import BevGrid
from presight_perception.models.camera_rig import CameraRig

GRID = BevGrid(24.0, 12.0, 6, 12)
SIZE = (32, 64)
EGO_FROM_FRONT = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])  # 1.5 m above the ground


def rig(batch: int = 2, camera_count: int = 2) -> CameraRig:
    """Cameras that look forward, then ever farther to the left, evenly around; 90 degrees wide."""
    height, width = SIZE
    intrinsics = torch.tensor([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1.0]])
    turns = []
    for angle in np.arange(camera_count) * 2 * np.pi / camera_count:
        cosine, sine = np.cos(angle), np.sin(angle)
        turns.append(np.array([[cosine, -sine, 0, 0], [sine, cosine, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))
    ego_from_camera = torch.tensor(np.stack(turns) @ EGO_FROM_FRONT).float()
    return CameraRig(intrinsics.expand(batch, camera_count, 3, 3), ego_from_camera.expand(batch, -1, -1, -1))


def pictures(batch: int = 2, camera_count: int = 2) -> torch.Tensor:
    return torch.rand(batch, camera_count, 3, *SIZE, generator=torch.Generator().manual_seed(3))


def prior(batch: int = 2, channels: int = 6, voxel_count: int = 200) -> PriorBatch:
    random = torch.Generator().manual_seed(4)
    shape = GRID.prior_grid.shape
    rows = torch.randperm(batch * int(np.prod(shape)), generator=random)[:voxel_count].numpy()
    coordinates = torch.from_numpy(np.stack(np.unravel_index(rows, (batch, *shape)), -1))
    return PriorBatch(
        torch.randn(voxel_count, channels, generator=random), coordinates, torch.eye(3).repeat(batch, 1, 1)
    )


def lines(side: float = 1.0) -> MapLines:
    """A crossing in front, two dividers along the road and a kerb at one side."""
    crossing = np.array([[4.0, -3], [6, -3], [6, 3], [4, 3], [4, -3]])
    along = np.array([[-11.0, 0], [0, 0.2], [11, 0]])
    return {
        "ped_crossing": [crossing],
        "divider": [along + np.array([0, 2 * side]), along],
        "boundary": [along + np.array([0, 5 * side])],
    }
