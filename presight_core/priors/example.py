"""Made-up tiles: for tests, benchmarks, and for trying a reader without a city."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from presight_core.grid import Lattice, morton
from presight_core.priors.schema import FEATURE_STEP, VoxelBatch, pack_columns, pack_voxels, word_count


@dataclass(frozen=True)
class ExampleTile:
    """A square of blocks around the world's origin, each with so many voxels at random places near the ground."""

    lattice: Lattice = field(default_factory=Lattice)
    side_blocks: int = 4
    voxels_per_block: int = 50
    channel_count: int = 8
    drive_count: int = 3
    layers: int = 20  # voxels high
    blocks_per_batch: int = 4
    seed: int = 0

    @property
    def blocks(self) -> NDArray[np.int32]:
        """Its blocks (B, 2) in Morton order; they lie on both sides of zero."""
        side = np.arange(self.side_blocks) - self.side_blocks // 2
        blocks = np.stack(np.meshgrid(side, side, indexing="ij"), -1).reshape(-1, 2).astype(np.int32)
        return blocks[np.argsort(morton(blocks))]

    def batches(self) -> Iterator[VoxelBatch]:
        """The tile's blocks in batches, always the same; each batch ends with a block without voxels."""
        random = np.random.default_rng(self.seed)
        blocks = self.blocks
        for first in range(0, len(blocks), self.blocks_per_batch):
            yield self._batch(blocks[first : first + self.blocks_per_batch], random)

    def _batch(self, blocks: NDArray[np.int32], random: np.random.Generator) -> VoxelBatch:
        counts = np.full(len(blocks), self.voxels_per_block)
        counts[-1] = 0
        voxel = np.concatenate([self._voxels(count, random) for count in counts])
        size, total = self.lattice.block_columns, len(voxel)
        # Places share most of their look, so that compression is neither helped nor hindered much.
        look = random.integers(0, 256, (16, self.channel_count))[random.integers(0, 16, total)]
        noisy = np.clip(look + random.normal(0, 10, look.shape), 0, 255)
        features = (noisy // FEATURE_STEP * FEATURE_STEP).astype(np.uint8)  # so that storing them changes nothing
        return VoxelBatch(
            block_index=blocks,
            block_start=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            observed=pack_columns(random.random((len(blocks), size, size)) < 0.5),
            voxel=voxel,
            centroid=random.integers(0, 256, (total, 3), np.uint8),
            features=features,
            hits=random.geometric(0.1, total).astype(np.uint32),
            density=random.gamma(2, 1, total).astype(np.float16),
            rgb=np.repeat(features[:, :1], 3, -1),
            drives=random.integers(1, 1 << self.drive_count, (total, word_count(self.drive_count))).astype(np.uint32),
        )

    def _voxels(self, count: int, random: np.random.Generator) -> NDArray[np.uint32]:
        size = self.lattice.block_columns
        chosen = random.choice(size * size * self.layers, count, replace=False)
        voxels = np.stack([chosen // size % size, chosen % size, chosen // size**2 - self.layers // 4], -1)
        return np.sort(pack_voxels(voxels, self.lattice))
