"""Sizes and clocks of `bench/gpu.py`."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from presight_core.config import CitySettings, GridSettings, load_city_settings

TINY = (
    "preset=demo", "training.batch_rays=8", "sampling.proposal_samples=[4, 3]", "sampling.field_samples=3",
    "field.grid.log2_rows=8", "field.grid.levels=3", "field.grid.max_resolution=64", "field.hidden_width=16",
    "field.proposal_width=16", "training.bfloat16=false",
)  # fmt: skip

Result = dict[str, Any]


@dataclass(frozen=True)
class Bench:
    """Where to run, and how large."""

    device: str
    size: str  # paper, or tiny

    @property
    def is_paper(self) -> bool:
        """Whether the sizes are those of the paper."""
        return self.size == "paper"

    @property
    def on_card(self) -> bool:
        """Whether times are a card's."""
        return self.device.startswith("cuda")

    @property
    def dtype(self) -> torch.dtype:
        """The networks' type; Triton's interpreter cannot multiply halves of the newer kind."""
        return torch.bfloat16 if self.is_paper else torch.float32

    @property
    def sub_field_count(self) -> int:
        """Sixteen in the paper's largest tiles."""
        return 16 if self.is_paper else 3

    @cached_property
    def settings(self) -> CitySettings:
        """Those of the paper, or of the demo made smaller still."""
        chosen = ("preset=paper",) if self.is_paper else TINY
        return load_city_settings(None, ["training.holdout_every=0", *chosen])

    @cached_property
    def grids(self) -> dict[str, tuple[GridSettings, int]]:
        """Each grid of the field, and how many points of it a step encodes."""
        sampling, field, rays = self.settings.sampling, self.settings.field, self.settings.training.batch_rays
        names = {f"proposal {i + 1}": grid for i, grid in enumerate(field.proposals)} | {"main": field.grid}
        counts = (*sampling.proposal_samples, sampling.field_samples)
        return {name: (grid, rays * count) for (name, grid), count in zip(names.items(), counts, strict=True)}

    def milliseconds(self, function: Callable[[], object], repeats: int = 20) -> float:
        """The median time of a call, after three to warm up."""
        repeats = repeats if self.on_card else 1
        for _ in range(3 if self.on_card else 1):
            function()
        return statistics.median(self.once(function) for _ in range(repeats))

    def once(self, function: Callable[[], object]) -> float:
        if not self.on_card:
            started = time.perf_counter()
            function()
            return (time.perf_counter() - started) * 1000
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        function()
        end.record()
        end.synchronize()
        return start.elapsed_time(end)

    def points(self, count: int) -> tuple[Tensor, Tensor]:
        """Points along rays through the unit cube, and the segments of sub-fields of unequal share."""
        start = torch.rand(-(-count // 64), 1, 3, device=self.device)
        end = torch.rand(len(start), 1, 3, device=self.device)
        along = torch.linspace(0, 1, 64, device=self.device)[None, :, None]
        points = (start + (end - start) * along).reshape(-1, 3)[:count].clamp(0, 1 - 1e-6)
        shares = torch.rand(self.sub_field_count, device=self.device).cumsum(0)
        segments = torch.zeros(self.sub_field_count + 1, dtype=torch.int64, device=self.device)
        segments[1:] = (shares / shares[-1] * count).long()
        segments[-1] = count
        return points.contiguous(), segments
