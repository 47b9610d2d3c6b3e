"""A trainable hash grid for each sub-field, in one table."""

import torch
from torch import Tensor, nn

from presight_core.config import GridSettings
from presight_core.field.hash_encode import grid_layout, hash_encode


class HashGrid(nn.Module):
    """The multi-resolution hash grids of all sub-fields."""

    offsets: Tensor
    levels: Tensor
    copy: Tensor | None = None  # the table in a smaller type, to read from: half the traffic on a card

    def __init__(self, settings: GridSettings, sub_field_count: int) -> None:
        super().__init__()
        layout = grid_layout(settings, sub_field_count)
        self.output_width = layout.output_width
        # Small random features: the first gradients, not the start, decide what a row becomes.
        self.table = nn.Parameter(torch.empty(layout.table_rows, layout.features).uniform_(-1e-3, 1e-3))
        self.register_buffer("offsets", layout.offsets(), persistent=False)
        self.register_buffer("levels", layout.levels(), persistent=False)

    def forward(self, points: Tensor, segments: Tensor) -> Tensor:
        """Encoded points (N, output_width) of positions (N, 3) in [0, 1), sorted by sub-field."""
        return hash_encode(points, segments, self.table, self.offsets, self.levels, self.copy)
