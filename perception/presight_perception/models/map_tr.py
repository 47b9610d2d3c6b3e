"""MapTR (Liao et al., 2023): queries of lines and of points, and a box for neither."""

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn

from presight_perception.map_truth import MAP_CLASSES
from presight_perception.metrics import ScoredLines
from presight_perception.models.attention import AttentionSettings, DecoderLayer
from presight_perception.models.backbone import ImageEncoderSettings, ResNetSettings
from presight_perception.models.bev_features import TINY_GRID, BevSettings, Sources
from presight_perception.models.bev_grid import BevGrid
from presight_perception.models.line_loss import LineLossSettings, LinePredictions
from presight_perception.models.line_model import LineModel, scored_lines
from presight_perception.models.line_truth import LineSettings
from presight_perception.models.map_model import rare_class_bias
from presight_perception.models.view_transform import BevFormerSettings

PAPER_IMAGES = ImageEncoderSettings(ResNetSettings(50, stages=(4,), frozen_stages=1, norm_eval=True, norm_learns=False))
PAPER_VIEW = BevFormerSettings((-1.5, -0.5, 0.5, 1.5), heads=4, sampling="kernel")  # GKT: one height a head
PAPER_GRID = BevGrid(100.0, 50.0, 100, 200)  # as many cells as at MapTR's 60 x 30 m, hence 0.5 m instead of 0.3 m
PAPER_LOSS = LineLossSettings(2.0, 5.0, 0.0, 0.005)


def _paper_bev() -> BevSettings:
    return BevSettings(PAPER_GRID, images=PAPER_IMAGES, view=PAPER_VIEW)


@dataclass(frozen=True)
class MapTrSettings:
    """Sizes and loss; the defaults are those of MapTR-tiny, at the paper's range."""

    bev: BevSettings = field(default_factory=_paper_bev)
    line_count: int = 50
    layer_count: int = 6
    heads: int = 8
    points: int = 4  # that a head samples around a query
    feedforward: int = 512
    lines: LineSettings = field(default_factory=lambda: LineSettings(20, "vertices"))
    loss: LineLossSettings = PAPER_LOSS
    decoded_count: int = 50  # surest lines that are kept

    @staticmethod
    def paper(sources: Sources | None = None) -> "MapTrSettings":
        """The published sizes: ResNet-50, 100 x 50 m."""
        return MapTrSettings(replace(_paper_bev(), sources=sources or Sources()))

    @staticmethod
    def tiny(sources: Sources | None = None, grid: BevGrid = TINY_GRID) -> "MapTrSettings":
        """Trains on two processor cores."""
        bev = BevSettings.tiny(sources or Sources(), grid)
        return MapTrSettings(bev, 20, 2, 4, 4, 128, LineSettings(10, "vertices"), PAPER_LOSS, 30)


class MapTr(LineModel):
    """Each of a line's points is a query: the sum of a line's and a point's embedding."""

    def __init__(self, settings: MapTrSettings | None = None) -> None:
        settings = settings or MapTrSettings()
        super().__init__(settings.bev, settings.lines, settings.loss)
        self.settings = settings
        channels, layers = settings.bev.channels, range(settings.layer_count)
        self.line_query = nn.Embedding(settings.line_count, 2 * channels)
        self.point_query = nn.Embedding(settings.lines.point_count, 2 * channels)
        self.first_place = nn.Linear(channels, 2)
        attention = AttentionSettings(channels, settings.heads, 1, settings.points)
        self.layers = nn.ModuleList(DecoderLayer(attention, settings.feedforward) for _ in layers)
        self.classify = nn.ModuleList(_classifier(channels) for _ in layers)
        self.refine = nn.ModuleList(_refinement(channels) for _ in layers)

    def predict(self, bev: Tensor) -> LinePredictions:
        memory = bev.flatten(2).transpose(1, 2)
        queries = (self.line_query.weight[:, None] + self.point_query.weight).flatten(0, 1).expand(len(bev), -1, -1)
        position, query = queries.chunk(2, -1)
        place = self.first_place(position).sigmoid()
        logits, lines = [], []
        for layer, classify, refine in zip(self.layers, self.classify, self.refine, strict=True):
            query = layer(query, position, place[:, :, None], memory, [tuple(bev.shape[-2:])])
            moved = (place.logit(eps=1e-5) + refine(query)).sigmoid()  # 1e-5: as in DETR's refinement
            by_line = (self.settings.line_count, self.settings.lines.point_count)
            logits.append(classify(query.unflatten(1, by_line).mean(2)))
            lines.append(moved.unflatten(1, by_line))
            place = moved.detach()
        return LinePredictions(torch.stack(logits), torch.stack(lines))

    @torch.no_grad()
    def decode(self, predictions: LinePredictions) -> list[ScoredLines]:
        """The surest pairs of line and class; a line may come with two classes."""
        scores, rows = predictions.logits[-1].sigmoid().flatten(1).topk(self.settings.decoded_count)
        lines_m = self.settings.bev.grid.metres_from_shares(predictions.lines[-1])
        classes = len(MAP_CLASSES)
        return [
            scored_lines(lines[row // classes], row % classes, score)
            for lines, row, score in zip(lines_m, rows, scores, strict=True)
        ]


def _classifier(channels: int) -> nn.Sequential:
    first = [nn.Linear(channels, channels), nn.LayerNorm(channels), nn.ReLU()]
    second = [nn.Linear(channels, channels), nn.LayerNorm(channels), nn.ReLU()]
    last = nn.Linear(channels, len(MAP_CLASSES))
    rare_class_bias(last)
    return nn.Sequential(*first, *second, last)


def _refinement(channels: int) -> nn.Sequential:
    first = [nn.Linear(channels, channels), nn.ReLU(), nn.Linear(channels, channels), nn.ReLU()]
    return nn.Sequential(*first, nn.Linear(channels, 2))
