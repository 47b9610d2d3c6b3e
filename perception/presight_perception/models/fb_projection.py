"""FB-OCC's backward projection: every cell of a BEV looks into the images where it projects to.

One layer of BEVFormer whose cross-attention weighs each place by the predicted chance that the ray ends there
(Li et al., 2023, eq. 2).
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from presight_perception.models.attention import AttentionSettings, DeformableAttention, Shapes
from presight_perception.models.camera_rig import CameraRig
from presight_perception.models.lift_splat import DepthBins, Size, moved
from presight_perception.voxelise import VoxelGrid


@dataclass(frozen=True)
class BackwardSettings:
    """Sizes of the backward projection; the defaults are FB-OCC's."""

    channels: int = 80
    heads: int = 8
    anchors: int = 4  # heights at which a cell looks
    points: int = 8  # places a head looks at, shared out to the anchors
    self_points: int = 4  # places of the BEV itself
    feedforward: int = 320


@dataclass(frozen=True)
class Views:
    """What the cameras have to offer."""

    context: Tensor  # (B, N, channels, h, w)
    depth: Tensor  # (B, N, D, h, w) probability of each bin
    rig: CameraRig
    image_size: Size


class BackwardProjection(nn.Module):
    """BEV features refined by looking back into the images."""

    def __init__(self, settings: BackwardSettings, grid: VoxelGrid, bins: DepthBins) -> None:
        super().__init__()
        channels, (columns, rows, _) = settings.channels, grid.shape
        self.settings, self.grid, self.bins = settings, grid, bins
        self.cells = nn.Parameter(torch.randn(rows * columns, channels))
        self.row = nn.Parameter(torch.rand(rows, channels // 2))  # uniform: as released
        self.column = nn.Parameter(torch.rand(columns, channels // 2))
        self.self_attention = DeformableAttention(AttentionSettings(channels, settings.heads, 1, settings.self_points))
        self.cross_attention = DeformableAttention(AttentionSettings(channels, settings.heads, 1, settings.points))
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(3))
        self.feedforward = nn.Sequential(
            nn.Linear(channels, settings.feedforward), nn.ReLU(), nn.Linear(settings.feedforward, channels)
        )

    def forward(self, bev: Tensor, views: Views) -> Tensor:
        """Refined features of bev (B, channels, Y, X)."""
        rows, columns = bev.shape[2:]
        query = self.cells + bev.flatten(2).transpose(1, 2)
        row, column = self.row[:, None].expand(-1, columns, -1), self.column.expand(rows, -1, -1)
        place = torch.cat([column, row], -1).flatten(0, 1)
        query = self.norms[0](query + self._look_around(query, query + place, [(rows, columns)]))
        query = self.norms[1](query + self._look_back(query + place, views))
        query = self.norms[2](query + self.feedforward(query))
        return query.transpose(1, 2).view_as(bev)

    def _look_around(self, value: Tensor, query: Tensor, shapes: Shapes) -> Tensor:
        rows, columns = ((torch.arange(count, device=query.device) + 0.5) / count for count in shapes[0])
        v, u = torch.meshgrid(rows, columns, indexing="ij")
        places = torch.stack([u, v], -1).view(1, -1, 1, 2).expand(len(query), -1, -1, -1)
        return self.self_attention(query, places, value, shapes)

    def _look_back(self, query: Tensor, views: Views) -> Tensor:
        """What each cell (B, Q, channels) finds, the mean over the cameras that see it."""
        batch, count = query.shape[:2]
        anchors = self._anchors(query)
        places, seen = views.rig.project(anchors, views.image_size)  # (B, N, Q, anchors, 2) and (B, N, Q, anchors)
        depths_m = moved(anchors.expand(*seen.shape, 3), views.rig.ego_from_camera.inverse())[..., 2]
        cameras = seen.shape[1]
        seen = seen.flatten(0, 1)
        sees = seen.any(-1)  # (B * N, Q)
        most = max(1, int(sees.sum(1).max()))
        chosen = sees.int().topk(most).indices  # a camera sees few cells
        counted = sees.gather(1, chosen)
        own = chosen + torch.arange(batch, device=query.device).repeat_interleave(cameras)[:, None] * count
        places = _rows(places.flatten(0, 1), chosen)
        chances = ray_ends(views.depth.flatten(0, 1), places, _rows(depths_m.flatten(0, 1), chosen), self.bins)
        chances = chances * _rows(seen, chosen)
        value = views.context.flatten(0, 1)
        shapes = [(value.shape[2], value.shape[3])]
        queries = query.flatten(0, 1)[own]
        found = self.cross_attention(queries, places, value.flatten(2).transpose(1, 2), shapes, chances)
        total = torch.zeros_like(query).flatten(0, 1)
        total = total.index_add(0, own.flatten(), (found * counted[..., None]).flatten(0, 1))
        lookers = sees.view(batch, cameras, count).sum(1).clamp(min=1)
        return total.view_as(query) / lookers[..., None]

    def _anchors(self, like: Tensor) -> Tensor:
        """Points (Q, anchors, 3) above each cell, ego metres."""
        columns, rows, _ = self.grid.shape
        axes = [
            low + (torch.arange(number, device=like.device) + 0.5) * ((high - low) / number)
            for low, high, number in zip(
                self.grid.low_m, self.grid.high_m, (columns, rows, self.settings.anchors), strict=True
            )
        ]
        y, x, z = torch.meshgrid(axes[1], axes[0], axes[2], indexing="ij")
        return torch.stack([x, y, z], -1).flatten(0, 1)


def ray_ends(depth: Tensor, places: Tensor, depths_m: Tensor, bins: DepthBins) -> Tensor:
    """The chance (B, Q, A) that the ray through each place ends in the bin of the given depth.

    depth (B, D, h, w); places (B, Q, A, 2) shares of the image; depths_m (B, Q, A). Depths beyond the bins count as of
    the nearest one, as released.
    """
    chances = functional.grid_sample(depth, 2 * places - 1, align_corners=False)  # (B, D, Q, A)
    number = ((depths_m - bins.low_m) / bins.step_m).floor().long().clamp(0, bins.count - 1)
    return chances.gather(1, number.unsqueeze(1)).squeeze(1)


def _rows(values: Tensor, chosen: Tensor) -> Tensor:
    """The rows (B, M, ...) of values (B, Q, ...) that `chosen` (B, M) names."""
    sample = torch.arange(len(values), device=values.device)[:, None]
    return values[sample, chosen]
