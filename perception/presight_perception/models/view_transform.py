"""From image features to the bird's-eye view: BEVFormer's attention, GKT's kernels, or a bilinear lift."""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from presight_core.errors import SettingsError
from presight_perception.deformable_attention import deformable_attention
from presight_perception.models.attention import (
    DROPOUT,
    AttentionSettings,
    DeformableAttention,
    FeedForward,
    SamplingAttention,
    Shapes,
)
from presight_perception.models.bev_grid import BevGrid
from presight_perception.models.camera_rig import CameraRig, Projection


@dataclass(frozen=True)
class LiftSettings:
    """A light view transform: features are read at a few heights above each cell, and stacked."""

    heights_m: tuple[float, ...] = (0.0, 1.0, 2.5)  # the road, cars, signs


@dataclass(frozen=True)
class BevFormerSettings:
    """BEVFormer's encoder without history; the defaults are StreamMapNet's."""

    heights_m: tuple[float, ...] = (-2.5, -1 / 6, 13 / 6, 4.5)  # even steps, half a metre inside -3..5 m
    layer_count: int = 1
    heads: int = 8
    points: int = 8  # of each head in each image level; the heights take turns
    self_heads: int = 8
    self_points: int = 8  # BEVFormer's 4 in each of two bird's-eye views, which are one without history
    feedforward: int = 512
    sampling: Literal["learned", "kernel"] = "learned"  # kernel: GKT's 3 x 5 pixels, each head at one of the heights

    def __post_init__(self) -> None:
        if self.sampling == "kernel" and len(self.heights_m) != self.heads:
            raise SettingsError(
                f"{self.heads} heads and {len(self.heights_m)} heights; sampling 'kernel' needs a height for each head"
            )
        if self.sampling == "learned" and self.points % len(self.heights_m):
            raise SettingsError(
                f"{self.points} points cannot be shared by {len(self.heights_m)} heights; take a multiple of them"
            )


class BilinearLift(nn.Module):
    """Reads each camera's finest level where a cell's pillar projects; the mean over the cameras that see it."""

    pillars: Tensor

    def __init__(self, settings: LiftSettings, grid: BevGrid, channels: tuple[int, int]) -> None:
        """`channels` are those of the images and of the bird's-eye view."""
        super().__init__()
        images, bev = channels
        self.register_buffer("pillars", grid.pillars(settings.heights_m), persistent=False)
        self.mix = nn.Sequential(
            nn.Conv2d(images * len(settings.heights_m), bev, 1, bias=False),
            nn.BatchNorm2d(bev),
            nn.ReLU(),
            *_dilated(bev, 1),
            *_dilated(bev, 2),
        )

    def forward(self, levels: list[Tensor], rig: CameraRig, image_size: tuple[int, int]) -> Tensor:
        """Features (B, C, rows, columns) of levels (B, N, C, h, w) of images of (height, width) pixels."""
        return self.mix(self.lift(levels[0], rig, image_size))

    def lift(self, level: Tensor, rig: CameraRig, image_size: tuple[int, int]) -> Tensor:
        """Features (B, C * heights, rows, columns), a channel's heights side by side; zeros where nobody sees."""
        places, seen = rig.project(self.pillars, image_size)
        rows, columns = self.pillars.shape[:2]
        grids = (2 * places - 1).flatten(0, 1).flatten(1, 2)  # (B * N, cells, heights, 2), -1..1 over the image
        found = functional.grid_sample(level.flatten(0, 1), grids, align_corners=False, padding_mode="border")
        found = found.unflatten(0, level.shape[:2]) * seen.flatten(2, 3)[:, :, None]
        mean = found.sum(1) / seen.sum(1).clamp(min=1).flatten(1, 2)[:, None]  # (B, C, cells, heights)
        return mean.transpose(2, 3).reshape(len(level), -1, rows, columns)


class BevFormer(nn.Module):
    """Cells as queries: they look at their neighbours, then into the images where their pillars project."""

    pillars: Tensor
    centres: Tensor

    def __init__(self, settings: BevFormerSettings, grid: BevGrid, channels: int, views: tuple[int, int]) -> None:
        """`views` are the numbers of cameras and of image levels."""
        super().__init__()
        camera_count, level_count = views
        self.grid = grid
        self.register_buffer("pillars", grid.pillars(settings.heights_m).flatten(0, 1), persistent=False)
        self.register_buffer("centres", grid.centres().view(1, -1, 1, 2), persistent=False)
        self.query = nn.Parameter(torch.randn(grid.rows * grid.columns, channels))
        self.row_position = nn.Parameter(torch.rand(grid.rows, channels // 2))
        self.column_position = nn.Parameter(torch.rand(grid.columns, channels // 2))
        self.camera_embedding = nn.Parameter(torch.randn(camera_count, 1, channels))
        self.level_embedding = nn.Parameter(torch.randn(level_count, channels))
        layers = (_BevFormerLayer(settings, channels, level_count) for _ in range(settings.layer_count))
        self.layers = nn.ModuleList(layers)

    def forward(self, levels: list[Tensor], rig: CameraRig, image_size: tuple[int, int]) -> Tensor:
        """Features (B, C, rows, columns) of levels (B, N, C, h, w) of images of (height, width) pixels."""
        batch, rows, columns = len(levels[0]), self.grid.rows, self.grid.columns
        projection = rig.project(self.pillars, image_size)
        shapes = [(level.shape[-2], level.shape[-1]) for level in levels]
        memory = [
            level.flatten(3).transpose(2, 3) + self.camera_embedding + embedding
            for level, embedding in zip(levels, self.level_embedding, strict=True)
        ]
        views, neighbours = _Views(projection, torch.cat(memory, 2), shapes), self._neighbours(batch)
        cells = self.query.expand(batch, -1, -1)
        for layer in self.layers:
            cells = layer(cells, neighbours, views)
        return cells.transpose(1, 2).reshape(batch, -1, rows, columns)

    def _neighbours(self, batch: int) -> "_Neighbours":
        rows, columns = self.grid.rows, self.grid.columns
        both = [self.column_position[None].expand(rows, -1, -1), self.row_position[:, None].expand(-1, columns, -1)]
        positions = torch.cat(both, -1).flatten(0, 1)
        return _Neighbours(positions, self.centres.expand(batch, -1, -1, -1), [(rows, columns)])


class KernelAttention(nn.Module):
    """Weighs the pixels of a small window around given places, each head around its own; GKT learns no offsets."""

    window: Tensor

    def __init__(self, settings: AttentionSettings) -> None:
        super().__init__()
        self.settings = settings
        self.register_buffer("window", _window(3, 5), persistent=False)
        self.value = nn.Linear(settings.channels, settings.channels)
        self.weights = nn.Linear(settings.channels, settings.heads * settings.levels * len(self.window))
        nn.init.zeros_(self.weights.weight)  # at first, all pixels weigh the same
        nn.init.zeros_(self.weights.bias)

    def forward(self, query: Tensor, places: Tensor, memory: Tensor, shapes: Shapes) -> Tensor:
        """What queries (B, Q, C) find near their places (B, Q, heads, 2) in memory (B, S, C), all levels' pixels."""
        settings = self.settings
        sizes = query.new_tensor([(width, height) for height, width in shapes])[:, None]  # (levels, 1, 2)
        pixels = (places[:, :, :, None, None] * sizes).floor() + self.window  # (B, Q, heads, levels, window, 2)
        inside = pixels.clamp(min=0).minimum(sizes - 1)  # beyond the edge, its pixels are repeated
        weights = self.weights(query).unflatten(-1, (settings.heads, -1)).softmax(-1)
        value = self.value(memory).unflatten(-1, (settings.heads, -1))
        weights = weights.unflatten(-1, (settings.levels, -1))
        return deformable_attention(value, shapes, (inside + 0.5) / sizes, weights)


@dataclass(frozen=True)
class _Neighbours:
    """What cells need to look at each other."""

    positions: Tensor  # (cells, C)
    centres: Tensor  # (B, cells, 1, 2) shares of the grid
    shapes: Shapes


@dataclass(frozen=True)
class _Views:
    """What the cameras have to offer."""

    projection: Projection  # of the cells' pillars: places (B, N, cells, heights, 2)
    memory: Tensor  # (B, N, S, C), all levels' pixels
    shapes: Shapes


class _BevFormerLayer(nn.Module):
    def __init__(self, settings: BevFormerSettings, channels: int, level_count: int) -> None:
        super().__init__()
        own = AttentionSettings(channels, settings.self_heads, 1, settings.self_points)
        images = AttentionSettings(channels, settings.heads, level_count, settings.points)
        learned = settings.sampling == "learned"
        self.self_attention = DeformableAttention(own)
        self.sampler = SamplingAttention(images) if learned else KernelAttention(images)
        self.output = nn.Linear(channels, channels)
        self.dropout = nn.Dropout(DROPOUT)
        self.feedforward = FeedForward(channels, settings.feedforward)
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(3))

    def forward(self, cells: Tensor, neighbours: _Neighbours, views: _Views) -> Tensor:
        found = self.self_attention(cells + neighbours.positions, neighbours.centres, cells, neighbours.shapes)
        cells = self.norms[0](cells + self.dropout(found))
        found = self.output(self._from_images(cells, views))
        cells = self.norms[1](cells + self.dropout(found))
        return self.norms[2](self.feedforward(cells))

    def _from_images(self, cells: Tensor, views: _Views) -> Tensor:
        """Means (B, cells, C) over the cameras that see a cell; each camera is asked for those in its sight alone."""
        places, seen = views.projection
        hits = seen.any(-1)  # (B, N, cells)
        most = max(int(hits.sum(-1).max()), 1)
        asked, rows = hits.int().topk(most)  # (B, N, most); cameras that see fewer cells answer for some others in vain
        cell = rows.flatten(1)[..., None].expand(-1, -1, cells.shape[-1])  # (B, N * most, C)
        queries = cells.gather(1, cell).view(-1, most, cells.shape[-1])
        where = places.gather(2, rows[..., None, None].expand(-1, -1, -1, *places.shape[-2:])).flatten(0, 1)
        found = self.sampler(queries, where, views.memory.flatten(0, 1), views.shapes)
        found = found * asked.view(-1, most, 1)
        total = torch.zeros_like(cells).scatter_add(1, cell, found.reshape(cell.shape))
        return total / hits.sum(1).clamp(min=1)[..., None]


def _window(height: int, width: int) -> Tensor:
    y, x = torch.meshgrid(torch.arange(height) - height // 2, torch.arange(width) - width // 2, indexing="ij")
    return torch.stack([x, y], -1).flatten(0, 1).float()


def _dilated(channels: int, dilation: int) -> list[nn.Module]:
    convolution = nn.Conv2d(channels, channels, 3, padding=dilation, dilation=dilation, bias=False)
    return [convolution, nn.BatchNorm2d(channels), nn.ReLU()]
