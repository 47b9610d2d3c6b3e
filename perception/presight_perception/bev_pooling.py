"""Pooling of lifted image features into voxels, in plain PyTorch (Lift, Splat, Shoot; BEVDet's bev_pool_v2)."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class PoolingGrid:
    """The voxels to pool into."""

    low_m: tuple[float, float, float]
    voxel_m: tuple[float, float, float]
    shape: tuple[int, int, int]  # voxels along x, y, z


def bev_pool(points_m: Tensor, depth: Tensor, features: Tensor, grid: PoolingGrid) -> Tensor:
    """Sums (B, C, Z, Y, X) over the points in each voxel of depth probability times image feature.

    points_m (B, N, D, H, W, 3) of N cameras and D depths, in the grid's frame; depth (B, N, D, H, W);
    features (B, N, C, H, W). As in BEVDet, cells are truncated toward zero: a point less than one voxel below the
    lower faces falls into the first cell.
    """
    x_count, y_count, z_count = grid.shape
    batch, channels = len(points_m), features.shape[2]
    cells = ((points_m - points_m.new_tensor(grid.low_m)) / points_m.new_tensor(grid.voxel_m)).long()
    inside = ((cells >= 0) & (cells < cells.new_tensor(grid.shape))).all(-1)
    x, y, z = cells.unbind(-1)
    sample = torch.arange(batch, device=cells.device).view(-1, 1, 1, 1, 1)
    row = ((sample * z_count + z) * y_count + y) * x_count + x
    outside = batch * z_count * y_count * x_count  # one more row, thrown away: no shape depends on the data
    row = torch.where(inside, row, outside)
    lifted = depth.unsqueeze(-1) * features.permute(0, 1, 3, 4, 2).unsqueeze(2)  # (B, N, D, H, W, C)
    pooled = lifted.new_zeros(outside + 1, channels).index_add(0, row.flatten(), lifted.flatten(0, 4))
    return pooled[:-1].view(batch, z_count, y_count, x_count, channels).permute(0, 4, 1, 2, 3)
