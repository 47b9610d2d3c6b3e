"""Which lattice columns the rays of a tile looked through: what tells "empty" from "unknown"."""

from collections.abc import Callable

import numba
import numpy as np
from numpy.typing import NDArray

from presight_core.grid import Lattice
from presight_core.priors.schema import pack_columns

Block = tuple[int, int]


class ObservedColumns:
    """Columns that rays passed through or hit, a bit each, for every block that any ray touched."""

    def __init__(self, lattice: Lattice, reach_m: float) -> None:
        """`reach_m`: no ray is longer."""
        self._lattice = lattice
        self._reach_blocks = int(np.ceil(reach_m / lattice.block_m))
        self._bits: dict[Block, NDArray[np.uint8]] = {}

    def add(self, origin_world: NDArray[np.float64], ends_world: NDArray[np.float64]) -> None:
        """Mark the columns between one origin (3,) and the ends (N, 3) of rays from it, both included."""
        size = self._lattice.block_columns
        centre = self._lattice.block_of(self._lattice.voxel_of(origin_world[None]))[0]
        first_block = centre.astype(np.int64) - self._reach_blocks
        blocks = 2 * self._reach_blocks + 1
        points = np.concatenate([origin_world[None], ends_world])
        columns = self._lattice.voxel_of(points)[:, :2] - first_block * size
        assert columns.min() >= 0 and columns.max() < blocks * size, "a ray is longer than reach_m"
        corner = self._lattice.block_centre(first_block) - self._lattice.block_m / 2
        seen = np.zeros((blocks * size, blocks * size), np.bool_)
        _mark_lines(seen, columns, (points[:, :2] - corner) / self._lattice.voxel_m)
        tiles = pack_columns(seen.reshape(blocks, size, blocks, size).swapaxes(1, 2))
        for x, y in np.argwhere(tiles.any((2, 3))).tolist():
            block = (int(first_block[0]) + x, int(first_block[1]) + y)
            self._bits[block] = self._bits[block] | tiles[x, y] if block in self._bits else tiles[x, y].copy()

    def keep(self, is_owned: Callable[[NDArray[np.int32]], NDArray[np.bool_]]) -> None:
        """Forget the blocks that belong to other tiles."""
        blocks = np.array(list(self._bits), np.int32).reshape(-1, 2)
        for block, owned in zip(list(self._bits), is_owned(blocks).tolist(), strict=True):
            if not owned:
                del self._bits[block]

    @property
    def blocks(self) -> set[Block]:
        """Blocks with any observed column."""
        return set(self._bits)

    def bits(self, block: Block) -> NDArray[np.uint8]:
        """The columns of one block, packed as stored (columns, columns / 8); none for an unseen block."""
        size = self._lattice.block_columns
        return self._bits.get(block, np.zeros((size, size // 8), np.uint8))


@numba.njit(cache=True)
def _mark_lines(seen: NDArray[np.bool_], cells: NDArray[np.int64], points: NDArray[np.float64]) -> None:
    """Mark the cells of `seen` that the lines from the first of `points` (1 + N, 2) to each other one touch.

    Cells are 1 x 1; `cells` (1 + N, 2) hold the points. Amanatides and Woo's walk: over the nearest edge
    from cell to cell.
    """
    for line in range(1, len(points)):
        x, y = cells[0]
        seen[x, y] = True
        last_x, last_y = cells[line]
        along_x, along_y = points[line] - points[0]
        step_x, step_y = (1 if last_x > x else -1), (1 if last_y > y else -1)
        # Share of the line at which it crosses the next edge in x, and in y.
        next_x = (x + (step_x > 0) - points[0, 0]) / along_x if along_x != 0 else np.inf
        next_y = (y + (step_y > 0) - points[0, 1]) / along_y if along_y != 0 else np.inf
        while x != last_x or y != last_y:
            if y == last_y or (x != last_x and next_x < next_y):
                x += step_x
                next_x += step_x / along_x
            else:
                y += step_y
                next_y += step_y / along_y
            seen[x, y] = True
