"""Neural Map Prior, to compare with (Xiong et al., CVPR 2023): a city-wide raster of a model's own BEV features.

The raster is read around a vehicle, fused with what its cameras see now, and the result is written back. It is made
by driving: a trained model passes over the prior drives and writes; a test reads what they left.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from presight_core.errors import InputError, SettingsError
from presight_perception.models.attention import DROPOUT
from presight_perception.models.bev_grid import BevGrid

BLOCK_CELLS = 64  # edge of the squares that memory is taken in: 19 m of cells of 0.3 m


@dataclass(frozen=True)
class NeuralMapSettings:
    """A raster of BEV features and how it is fused; the defaults are the published ones, on the paper's range."""

    grid: BevGrid = field(default_factory=BevGrid)
    channels: int = 256
    cell_m: float = 0.3  # of the raster; the vehicle's grid may be coarser
    window: tuple[int, int] = (10, 20)  # rows and columns that look at each other
    heads: int = 8


class NeuralMap:
    """The rasters of cities, in memory: float16, in blocks that exist where something was written; zeros elsewhere."""

    def __init__(self, settings: NeuralMapSettings) -> None:
        self.settings = settings
        self._centres = settings.grid.pillars((0.0,))[:, :, 0, :2].flatten(0, 1).double()
        self._blocks: dict[_BlockKey, Tensor] = {}  # (BLOCK_CELLS along x, along y, channels)

    @property
    def size_bytes(self) -> int:
        """Memory of the blocks."""
        return sum(block.nbytes for block in self._blocks.values())

    def clear(self) -> None:
        """Forget everything: done before each epoch of a training."""
        self._blocks.clear()

    def read(self, city: str, world_from_ego: ArrayLike) -> Tensor:
        """Features (channels, rows, columns), float32, of the raster's cells that hold the grid's centres."""
        settings = self.settings
        turn, place = _on_ground(world_from_ego)
        cells = ((self._centres @ turn.T + place) / settings.cell_m).floor().long()
        found = torch.zeros(len(cells), settings.channels)
        for key, rows, (x, y) in _by_block(city, cells):
            if key in self._blocks:
                found[rows] = self._blocks[key][x, y].float()
        return found.T.reshape(settings.channels, settings.grid.rows, settings.grid.columns)

    def write(self, city: str, world_from_ego: ArrayLike, bev: Tensor) -> None:
        """Replace what the raster holds under the grid by features (channels, rows, columns).

        Each cell of the raster takes those of the grid's cell that holds its centre. Raises InputError for features
        of another shape.
        """
        settings, grid = self.settings, self.settings.grid
        expected = (settings.channels, grid.rows, grid.columns)
        if bev.shape != expected:
            raise InputError(f"features {tuple(bev.shape)} for a map of {expected}; write a sample at a time")
        turn, place = _on_ground(world_from_ego)
        cells = self._cells_around(turn, place)
        points_ego = ((cells + 0.5) * settings.cell_m - place) @ torch.linalg.inv(turn).T
        places = (grid.shares_from_metres(points_ego) * torch.tensor([grid.columns, grid.rows])).floor().long()
        inside = ((places >= 0) & (places < torch.tensor([grid.columns, grid.rows]))).all(-1)
        cells, (columns, rows) = cells[inside], places[inside].unbind(-1)
        values = bev.detach().permute(1, 2, 0).to("cpu", torch.float16).contiguous()[rows, columns]
        for key, written, (x, y) in _by_block(city, cells):
            if key not in self._blocks:
                self._blocks[key] = torch.zeros(BLOCK_CELLS, BLOCK_CELLS, settings.channels, dtype=torch.float16)
            self._blocks[key][x, y] = values[written]

    def _cells_around(self, turn: Tensor, place: Tensor) -> Tensor:
        """All cells (N, 2) of the rectangle, along the world's axes, around the grid."""
        half = torch.tensor([self.settings.grid.length_m / 2, self.settings.grid.width_m / 2]).double()
        reach = turn.abs() @ half
        low, high = (((place + side * reach) / self.settings.cell_m).floor().long() for side in (-1, 1))
        x, y = (torch.arange(int(first), int(last) + 1) for first, last in zip(low, high, strict=True))
        return torch.cartesian_prod(x, y)


class MapPriorFusion(nn.Module):
    """Fuses what `NeuralMap` read into BEV features: attention in windows, gates by distance, a recurrent unit."""

    distances: Tensor

    def __init__(self, settings: NeuralMapSettings) -> None:
        """Raises SettingsError for windows that the grid cannot be cut into."""
        super().__init__()
        channels, rows, columns = settings.channels, settings.grid.rows, settings.grid.columns
        if rows % settings.window[0] or columns % settings.window[1]:
            raise SettingsError(f"{rows} x {columns} cells cannot be cut into windows of {settings.window}")
        self.settings = settings
        self.register_buffer("distances", _distances(settings.grid), persistent=False)
        cells = settings.window[0] * settings.window[1]
        self.position = nn.Parameter(0.02 * torch.randn(cells, channels))
        self.prior_position = nn.Parameter(0.02 * torch.randn(cells, channels))
        self.attention = nn.MultiheadAttention(channels, settings.heads, DROPOUT, add_zero_attn=True, batch_first=True)
        self.norm = nn.LayerNorm(channels)
        self.balance = nn.Conv2d(2 * channels + len(self.distances), channels, 3, padding=1, bias=False)
        self.update = nn.Conv2d(2 * channels, channels, 3, padding=1, bias=False)
        self.reset = nn.Conv2d(2 * channels, channels, 3, padding=1, bias=False)
        self.candidate = nn.Conv2d(2 * channels, channels, 3, padding=1, bias=False)

    def forward(self, bev: Tensor, prior: Tensor) -> Tensor:
        """Fused features, to decode and to write back, of two (B, channels, rows, columns); -1 to 1."""
        bev = bev + self._recalled(bev, prior)
        distances = self.distances.expand(len(bev), -1, -1, -1)
        share = self.balance(torch.cat([prior, bev, distances], 1)).sigmoid()
        return self._recurrent((1 - share) * prior, share * bev)

    def _recalled(self, bev: Tensor, prior: Tensor) -> Tensor:
        """What cells find in the prior of their window; where none was written, they look at zeros."""
        keys = self._windows(prior)
        unwritten = (keys == 0).all(-1)
        query = self._windows(bev) + self.position
        found, _ = self.attention(query, keys + self.prior_position, keys, unwritten, need_weights=False)
        return self._grid(self.norm(found))

    def _recurrent(self, prior: Tensor, bev: Tensor) -> Tensor:
        both = torch.cat([prior, bev], 1)
        update, reset = self.update(both).sigmoid(), self.reset(both).sigmoid()
        candidate = self.candidate(torch.cat([reset * prior, bev], 1)).tanh()
        return (1 - update) * prior + update * candidate

    def _windows(self, features: Tensor) -> Tensor:
        """Windows (B * count, cells, C) of features (B, C, rows, columns)."""
        height, width = self.settings.window
        cut = features.unflatten(3, (-1, width)).unflatten(2, (-1, height))  # B, C, down, height, across, width
        return cut.permute(0, 2, 4, 3, 5, 1).flatten(3, 4).flatten(0, 2)

    def _grid(self, windows: Tensor) -> Tensor:
        """The inverse."""
        (height, width), grid = self.settings.window, self.settings.grid
        shape = (-1, grid.rows // height, grid.columns // width, height, width, self.settings.channels)
        return windows.view(shape).permute(0, 5, 1, 3, 2, 4).flatten(4, 5).flatten(2, 3)


_BlockKey = tuple[str, int, int]


class _Part(NamedTuple):
    """The cells that lie in one block."""

    key: _BlockKey
    rows: Tensor  # (N,) of the cells asked for
    inside: tuple[Tensor, Tensor]  # x and y in the block


def _by_block(city: str, cells: Tensor) -> Iterator[_Part]:
    blocks = cells.div(BLOCK_CELLS, rounding_mode="floor")
    low_x, low_y = blocks.amin(0).tolist()
    width = int(blocks[:, 1].max()) - low_y + 1
    numbers = (blocks[:, 0] - low_x) * width + blocks[:, 1] - low_y  # sorted faster than pairs
    for number in numbers.unique().tolist():
        rows = (numbers == number).nonzero()[:, 0]
        inside = cells[rows] % BLOCK_CELLS
        yield _Part((city, low_x + number // width, low_y + number % width), rows, (inside[:, 0], inside[:, 1]))


def _on_ground(world_from_ego: ArrayLike) -> tuple[Tensor, Tensor]:
    """What takes points of the ego ground plane to the map: `points @ turn.T + place`. Mirrored frames may be."""
    transform = torch.as_tensor(world_from_ego, dtype=torch.float64)
    return transform[:2, :2], transform[:2, 3]


def _distances(grid: BevGrid) -> Tensor:
    """How far cells are from the vehicle (3, rows, columns): along, across and straight, 1 being the farthest."""
    along, across = (2 * grid.centres() - 1).abs().unbind(-1)
    return torch.stack([along, across, torch.hypot(along, across) / 2**0.5])
