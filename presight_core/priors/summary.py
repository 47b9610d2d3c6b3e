"""What is compared when a new build of a tile is to replace an old one."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from presight_core.grid import morton
from presight_core.priors.schema import unpack_columns


@dataclass(frozen=True)
class TileSummary:
    """The extent of one build of a tile: how many voxels it has, and which columns it observed."""

    voxel_count: int
    block_index: NDArray[np.int32]  # (B, 2) ascending Morton order
    observed: NDArray[np.uint8]  # (B, columns, columns / 8) bits, as stored

    @property
    def observed_columns(self) -> int:
        """Columns that some ray passed through or hit."""
        return int(unpack_columns(self.observed).sum())

    def kept_share(self, old: "TileSummary") -> float:
        """Share of the old build's observed columns that this one observed too, 0..1; 1 if the old one had none."""
        _, here, there = np.intersect1d(
            morton(self.block_index), morton(old.block_index), assume_unique=True, return_indices=True
        )
        kept = int(unpack_columns(self.observed[here] & old.observed[there]).sum())
        return kept / old.observed_columns if old.observed_columns else 1.0
