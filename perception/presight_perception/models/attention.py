"""Attention layers of the models' encoders and decoders."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from presight_perception.deformable_attention import deformable_attention

DROPOUT = 0.1  # of all the models
Shapes = Sequence[tuple[int, int]]  # (height, width) of each level


@dataclass(frozen=True)
class AttentionSettings:
    """Sizes of a sampling attention."""

    channels: int = 256
    heads: int = 8
    levels: int = 1
    points: int = 4  # of each head in each level


class SamplingAttention(nn.Module):
    """Samples at learned offsets from given places, and weighs the samples (Deformable DETR)."""

    def __init__(self, settings: AttentionSettings) -> None:
        super().__init__()
        self.settings = settings
        places = settings.heads * settings.levels * settings.points
        self.value = nn.Linear(settings.channels, settings.channels)
        self.offsets = nn.Linear(settings.channels, places * 2)
        self.weights = nn.Linear(settings.channels, places)
        self._initialise()

    def forward(
        self, query: Tensor, places: Tensor, memory: Tensor, shapes: Shapes, chances: Tensor | None = None
    ) -> Tensor:
        """What queries (B, Q, C) find around their places (B, Q, R, 2) in memory (B, S, C), all levels' pixels.

        Places are shares of the image; with R > 1 the sampled points take turns around them. What is found around a
        place is scaled by its chance (B, Q, R).
        """
        settings = self.settings
        kinds = (settings.heads, settings.levels, settings.points)
        sizes = query.new_tensor([(width, height) for height, width in shapes])
        offsets = self.offsets(query).unflatten(-1, (*kinds, 2)) / sizes[:, None]
        turns = places.repeat(1, 1, settings.points // places.shape[2], 1)[:, :, None, None]
        weights = self.weights(query).unflatten(-1, (settings.heads, -1)).softmax(-1).unflatten(-1, kinds[1:])
        if chances is not None:
            weights = weights * chances.repeat(1, 1, settings.points // places.shape[2])[:, :, None, None]
        value = self.value(memory).unflatten(-1, (settings.heads, -1))
        return deformable_attention(value, shapes, turns + offsets, weights)

    def _initialise(self) -> None:
        """Each head looks in its own direction, each point farther than the last; all weigh the same."""
        settings = self.settings
        angles = torch.arange(settings.heads) * (2 * math.pi / settings.heads)
        directions = torch.stack([angles.cos(), angles.sin()], -1)
        directions = directions / directions.abs().amax(-1, keepdim=True)
        steps = torch.arange(1, settings.points + 1)
        offsets = directions[:, None, None] * steps[:, None]  # (heads, 1, points, 2)
        nn.init.zeros_(self.offsets.weight)
        with torch.no_grad():
            self.offsets.bias.copy_(offsets.expand(-1, settings.levels, -1, -1).flatten())
        nn.init.zeros_(self.weights.weight)
        nn.init.zeros_(self.weights.bias)
        nn.init.xavier_uniform_(self.value.weight)
        nn.init.zeros_(self.value.bias)


class DeformableAttention(SamplingAttention):
    """The same with a projection of what was found."""

    def __init__(self, settings: AttentionSettings) -> None:
        super().__init__(settings)
        self.output = nn.Linear(settings.channels, settings.channels)
        nn.init.xavier_uniform_(self.output.weight)
        nn.init.zeros_(self.output.bias)

    def forward(
        self, query: Tensor, places: Tensor, memory: Tensor, shapes: Shapes, chances: Tensor | None = None
    ) -> Tensor:
        return self.output(super().forward(query, places, memory, shapes, chances))


class FeedForward(nn.Module):
    """Two layers beside a shortcut."""

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        first = [nn.Linear(channels, hidden), nn.ReLU(), nn.Dropout(DROPOUT)]
        self.layers = nn.Sequential(*first, nn.Linear(hidden, channels), nn.Dropout(DROPOUT))
        self.apply(initialise_linear)

    def forward(self, features: Tensor) -> Tensor:
        return features + self.layers(features)


class DecoderLayer(nn.Module):
    """Queries look at each other, then into the bird's-eye view."""

    def __init__(self, settings: AttentionSettings, feedforward: int) -> None:
        super().__init__()
        channels = settings.channels
        self.self_attention = nn.MultiheadAttention(channels, settings.heads, DROPOUT, batch_first=True)
        self.cross_attention = DeformableAttention(settings)
        self.dropout = nn.Dropout(DROPOUT)
        self.feedforward = FeedForward(channels, feedforward)
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(3))

    def forward(self, query: Tensor, position: Tensor | float, places: Tensor, memory: Tensor, shape: Shapes) -> Tensor:
        """New queries (B, Q, C); `position` is added to them where they search, `places` (B, Q, R, 2) is where."""
        placed = query + position
        found, _ = self.self_attention(placed, placed, query, need_weights=False)
        query = self.norms[0](query + self.dropout(found))
        found = self.cross_attention(query + position, places, memory, shape)
        query = self.norms[1](query + self.dropout(found))
        return self.norms[2](self.feedforward(query))


def initialise_linear(layer: nn.Module) -> None:
    """Glorot's initialisation, which the released transformers have everywhere; for `Module.apply`."""
    if isinstance(layer, nn.Linear):
        nn.init.xavier_uniform_(layer.weight)


def sine_positions(rows: int, columns: int, channels: int) -> Tensor:
    """Positions (rows * columns, channels) as waves of many lengths, half the channels for rows (DETR)."""
    lengths = 10_000 ** (2 * (torch.arange(channels // 2) // 2) / (channels // 2))  # as in the transformer's paper
    waves = []
    for count in (rows, columns):
        angles = (torch.arange(1, count + 1) / count * 2 * math.pi)[:, None] / lengths
        waves.append(torch.stack([angles[:, 0::2].sin(), angles[:, 1::2].cos()], -1).flatten(1))
    row, column = waves
    both = [row[:, None].expand(-1, columns, -1), column[None].expand(rows, -1, -1)]
    return torch.cat(both, -1).flatten(0, 1)
