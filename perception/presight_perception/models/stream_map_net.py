"""StreamMapNet (Yuan et al., 2024) without its streaming: the paper uses no history for mapping."""

from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from presight_perception.map_truth import MAP_CLASSES
from presight_perception.metrics import ScoredLines
from presight_perception.models.attention import AttentionSettings, DecoderLayer, initialise_linear, sine_positions
from presight_perception.models.bev_features import TINY_GRID, BevSettings, Sources
from presight_perception.models.bev_grid import BevGrid
from presight_perception.models.line_loss import LineLossSettings, LinePredictions
from presight_perception.models.line_model import LineModel, scored_lines
from presight_perception.models.line_truth import LineSettings
from presight_perception.models.map_model import rare_class_bias


@dataclass(frozen=True)
class StreamMapNetSettings:
    """Sizes and loss; the defaults are the paper's."""

    bev: BevSettings = field(default_factory=BevSettings)
    channels: int = 512  # of the queries
    query_count: int = 100
    layer_count: int = 6
    heads: int = 8
    feedforward: int = 1024
    regression: int = 1024  # channels of the layers that draw lines
    lines: LineSettings = field(default_factory=LineSettings)
    loss: LineLossSettings = field(default_factory=LineLossSettings)

    @staticmethod
    def paper(sources: Sources | None = None) -> "StreamMapNetSettings":
        """The published sizes: ResNet-50, 100 x 50 m."""
        return StreamMapNetSettings(BevSettings(sources=sources or Sources()))

    @staticmethod
    def tiny(sources: Sources | None = None, grid: BevGrid = TINY_GRID) -> "StreamMapNetSettings":
        """Trains on two processor cores."""
        bev = BevSettings.tiny(sources or Sources(), grid)
        return StreamMapNetSettings(bev, 64, 30, 2, 4, 128, 128, LineSettings(10), LineLossSettings(5.0, 5.0))


class StreamMapNet(LineModel):
    """Each query draws one line, and looks into the bird's-eye view around all points of that line."""

    positions: Tensor

    def __init__(self, settings: StreamMapNetSettings | None = None) -> None:
        settings = settings or StreamMapNetSettings()
        super().__init__(settings.bev, settings.lines, settings.loss)
        self.settings = settings
        channels, points, grid = settings.channels, settings.lines.point_count, settings.bev.grid
        self.input = nn.Conv2d(settings.bev.channels, channels, 1)
        self.register_buffer("positions", sine_positions(grid.rows, grid.columns, channels), persistent=False)
        self.query = nn.Embedding(settings.query_count, channels)
        self.first_line = nn.Linear(channels, 2 * points)
        attention = AttentionSettings(channels, settings.heads, 1, points)
        layers = (DecoderLayer(attention, settings.feedforward) for _ in range(settings.layer_count))
        self.layers = nn.ModuleList(layers)
        self.classify = nn.Linear(channels, len(MAP_CLASSES))
        self.draw = _drawing(channels, settings.regression, 2 * points)
        for part in (self.first_line, self.draw):
            part.apply(initialise_linear)
        rare_class_bias(self.classify)

    def predict(self, bev: Tensor) -> LinePredictions:
        memory = self.input(bev).flatten(2).transpose(1, 2) + self.positions
        query = self.query.weight.expand(len(bev), -1, -1)
        line = self.first_line(query).sigmoid().unflatten(-1, (-1, 2))
        logits, lines = [], []
        for layer in self.layers:
            query = layer(query, 0.0, line, memory, [tuple(bev.shape[-2:])])
            lines.append(self.draw(query).sigmoid().unflatten(-1, (-1, 2)))
            logits.append(self.classify(query))
            line = lines[-1].detach()
        return LinePredictions(torch.stack(logits), torch.stack(lines))

    @torch.no_grad()
    def decode(self, predictions: LinePredictions) -> list[ScoredLines]:
        """All queries, each with its likeliest class."""
        scores, labels = predictions.logits[-1].sigmoid().max(-1)
        lines_m = self.settings.bev.grid.metres_from_shares(predictions.lines[-1])
        return [scored_lines(*sample) for sample in zip(lines_m, labels, scores, strict=True)]


def _drawing(channels: int, hidden: int, outputs: int) -> nn.Sequential:
    first = [nn.Linear(channels, hidden), nn.LayerNorm(hidden), nn.ReLU()]
    return nn.Sequential(*first, nn.Linear(hidden, hidden), nn.LayerNorm(hidden), nn.ReLU(), nn.Linear(hidden, outputs))
