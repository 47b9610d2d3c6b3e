"""Makes a city as large as Boston's priors out of copies of a small one, so that its content is that of a real prior.

Run with `python -m bench.prior_city SOURCE_STORE CITY STORE`; 20 million voxels in eight tiles, 1.1 GB, city "large".
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from presight_core.grid import morton
from presight_core.priors import PriorReader
from presight_core.priors.documents import GenerationTile
from presight_core.priors.schema import VoxelBatch
from storage.priors import PriorStore
from storage.tile_groups import TileName

VOXELS = 20_000_000  # the released priors of Boston hold about 22 million
TILE_COUNT = 8  # as many as Boston's
BLOCKS_PER_BATCH = 256
VOXEL_COLUMNS = ("voxel", "centroid", "features", "hits", "density", "rgb")
LARGE = "large"


@dataclass(frozen=True)
class Copies:
    """A small city in memory, and where its copies go: block offsets (K, 2)."""

    blocks: NDArray[np.int32]  # (B, 2) of all its tiles
    starts: NDArray[np.int64]  # (B,) first row of each block
    counts: NDArray[np.int64]  # (B,)
    columns: dict[str, NDArray]
    observed: NDArray[np.uint8]
    offsets: NDArray[np.int32]

    @staticmethod
    def of(reader: PriorReader) -> "Copies":
        """Enough copies, side by side, for `VOXELS`."""
        tables = [reader.tile(tile_id) for tile_id in reader.tiles]
        first_rows = np.cumsum([0, *(table.block_start[-1] for table in tables)])
        blocks = np.concatenate([table.block_index for table in tables])
        columns = {name: np.concatenate([table.all_rows(name) for table in tables]) for name in VOXEL_COLUMNS}
        side = int(np.ceil(np.sqrt(VOXELS / first_rows[-1])))
        steps = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)
        steps = steps[: round(VOXELS / first_rows[-1])]
        return Copies(
            blocks,
            np.concatenate([table.block_start[:-1] + first for table, first in zip(tables, first_rows, strict=False)]),
            np.concatenate([np.diff(table.block_start) for table in tables]),
            columns,
            np.concatenate([table.observed for table in tables]),
            (steps * (np.ptp(blocks, 0) + 1)).astype(np.int32),
        )

    def batches(self, offsets: NDArray[np.int32]) -> Iterator[VoxelBatch]:
        """The blocks of some copies, as one tile."""
        blocks = (self.blocks + offsets[:, None]).reshape(-1, 2)
        order = np.argsort(morton(blocks))
        for first in range(0, len(order), BLOCKS_PER_BATCH):
            chosen = order[first : first + BLOCKS_PER_BATCH]
            source = chosen % len(self.blocks)
            counts = self.counts[source]
            ends = np.cumsum(counts)
            rows = np.arange(ends[-1]) + np.repeat(self.starts[source] - ends + counts, counts)
            yield VoxelBatch(
                block_index=blocks[chosen],
                block_start=np.concatenate([[0], ends]).astype(np.int64),
                observed=self.observed[source],
                drives=np.ones((len(rows), 1), np.uint32),
                **{name: column[rows] for name, column in self.columns.items()},
            )


def main(source: str, city: str, location: Path) -> None:
    """Write and publish the large city."""
    reader = PriorReader.open(source, city)
    copies = Copies.of(reader)
    store = PriorStore.open(location)
    store.create_city(LARGE, reader.lattice, reader.space_id, reader.channel_count)
    tiles, registry = {}, []
    for number, offsets in enumerate(np.array_split(copies.offsets, TILE_COUNT)):
        tile_id = f"t{number:03d}"
        entry = store.write_tile(LARGE, TileName(tile_id, "build"), copies.batches(offsets), ["drive"], {})
        tiles[tile_id] = GenerationTile(entry, {})
        registry.append({"tile_id": tile_id, "centroid_m": (offsets.mean(0) * reader.lattice.block_m).tolist()})
        print(f"{tile_id}: {entry.voxel_count:,} voxels, {entry.bytes / entry.voxel_count:.1f} bytes a voxel")
    store.publish(LARGE, tiles, None, {"tiling_id": "copies", "city": LARGE, "tiles": registry})


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], Path(sys.argv[3]))
