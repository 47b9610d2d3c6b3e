"""Where the levels of a multi-resolution hash grid lie in one flat table."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from presight_core.config import GridSettings

ROW_MULTIPLE = 8  # dense levels are padded, so that every level starts on a 32-byte boundary at any feature count


@dataclass(frozen=True)
class GridLayout:
    """Levels that every sub-field has alike; sub-fields follow one another in the table."""

    resolutions: tuple[int, ...]  # cells along an edge
    rows: tuple[int, ...]  # table rows of each level
    hashed: tuple[bool, ...]  # False: every lattice corner has its own row
    features: int  # columns of the table
    sub_field_count: int

    @property
    def table_rows(self) -> int:
        """Rows of the whole table."""
        return self.sub_field_count * sum(self.rows)

    @property
    def output_width(self) -> int:
        """Values an encoded point has."""
        return len(self.rows) * self.features

    def offsets(self) -> Tensor:
        """First row (sub-fields, levels) of each level, int64: sixteen sub-fields of 2^20 rows a level pass 2^31."""
        ends = np.cumsum(self.rows, dtype=np.int64)
        starts = ends - self.rows
        return torch.from_numpy(starts[None] + np.arange(self.sub_field_count)[:, None] * ends[-1])

    def levels(self) -> Tensor:
        """Resolution, row count and hashed-or-dense (1 or 0) of each level (levels, 3), int64."""
        return torch.tensor([self.resolutions, self.rows, self.hashed], dtype=torch.int64).T.contiguous()


def grid_layout(settings: GridSettings, sub_field_count: int = 1, dense_coarse: bool = True) -> GridLayout:
    """The layout of a grid: geometric resolutions, coarse levels dense where they fit into a hashed one's rows.

    With `dense_coarse` False every level is hashed, as in nerfstudio's torch implementation.
    """
    resolutions = level_resolutions(settings)
    limit = 1 << settings.log2_rows
    corners = [(resolution + 1) ** 3 for resolution in resolutions]
    hashed = tuple(not dense_coarse or count > limit for count in corners)
    rows = tuple(
        limit if is_hashed else -(-count // ROW_MULTIPLE) * ROW_MULTIPLE
        for count, is_hashed in zip(corners, hashed, strict=True)
    )
    return GridLayout(resolutions, rows, hashed, settings.features_per_level, sub_field_count)


def level_resolutions(settings: GridSettings) -> tuple[int, ...]:
    """Cells along an edge for each level, a geometric series from the smallest to the largest resolution.

    Each power is rounded to float32 before the product is floored, as in nerfstudio, so that tables mean the
    same in both: the largest may lose a cell (4095 of 4096 with 8 levels), and does so on every machine.
    """
    steps = max(settings.levels - 1, 1)
    growth = np.exp((np.log(settings.max_resolution) - np.log(settings.min_resolution)) / steps)
    powers = np.float64(np.float32(growth)) ** np.arange(settings.levels)
    return tuple(int(cells) for cells in np.float32(settings.min_resolution) * powers.astype(np.float32))
