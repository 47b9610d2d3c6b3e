"""A stored tile: the names, types and meaning of its arrays, and how voxels are packed into them.

A tile is a table of voxels sorted by block (Morton order) and then by packed voxel, with an index of
blocks beside it. `docs/prior-format.md` describes the same for readers in other languages.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from presight_core.errors import StoreError
from presight_core.grid import Lattice, morton

FORMAT_VERSION = 1  # a reader refuses a larger one
FORMAT_MINOR = 0  # additions that older readers of the same version may ignore
CENTROID_STEPS = 256  # a centroid is stored in this many steps along each edge of its voxel
HEIGHT_OFFSET = 1 << 15  # shifts signed voxel heights into 16 bits: +-13 km at 0.4 m
WORD_BITS = 32  # drives per word of the drive bit set
FEATURE_STEP = 3  # features are kept in steps of 3/255: docs/benchmarks/store.md weighs size against error
FEATURE_CHUNK_ROWS = 1 << 11  # voxels a chunk, two blocks of a street: a window decodes little that it does not need
CHUNK_ROWS = 1 << 13  # of the narrow columns, where the cost is in the number of chunks more than in their size
NARROW_BYTES = 16  # a row
BLOCK_CHUNK_ROWS = 1 << 10  # blocks a chunk: 128 kB of observed columns


@dataclass(frozen=True)
class ArraySpec:
    """One array of a tile group: its type, the shape of one row, and what a row stands for."""

    dtype: str
    row_shape: tuple[int, ...]
    rows: Literal["block", "block edge", "voxel"]
    chunk_rows: int = 0  # rows of a chunk, the other axes are never cut; 0 becomes this program's choice

    def __post_init__(self) -> None:
        if not self.chunk_rows:
            object.__setattr__(self, "chunk_rows", self._chosen_chunk_rows)

    @property
    def row_bytes(self) -> int:
        """Bytes of one row before compression."""
        return int(np.prod(self.row_shape, dtype=np.int64)) * np.dtype(self.dtype).itemsize

    @property
    def _chosen_chunk_rows(self) -> int:
        if self.rows != "voxel":
            return BLOCK_CHUNK_ROWS
        return CHUNK_ROWS if self.row_bytes <= NARROW_BYTES else FEATURE_CHUNK_ROWS

    def with_chunk_rows(self, chunk_rows: int) -> "ArraySpec":
        """The same array in other chunks: readers take their size from the store."""
        return replace(self, chunk_rows=chunk_rows)

    def chunk_count(self, row_count: int) -> int:
        """Chunks that hold so many rows."""
        return -(-row_count // self.chunk_rows)


def array_specs(channel_count: int, drive_count: int, block_columns: int) -> dict[str, ArraySpec]:
    """The arrays of a tile with C feature channels and a number of drives, by name."""
    return {
        "block_index": ArraySpec("int32", (2,), "block"),
        "block_start": ArraySpec("int64", (), "block edge"),
        "observed": ArraySpec("uint8", (block_columns, block_columns // 8), "block"),
        "voxel": ArraySpec("uint32", (), "voxel"),
        "centroid": ArraySpec("uint8", (3,), "voxel"),
        "features": ArraySpec("uint8", (channel_count,), "voxel"),
        "hits": ArraySpec("uint32", (), "voxel"),
        "density": ArraySpec("float16", (), "voxel"),
        "rgb": ArraySpec("uint8", (3,), "voxel"),
        "drives": ArraySpec("uint32", (word_count(drive_count),), "voxel"),
    }


def word_count(drive_count: int) -> int:
    """Words of the bit set of so many drives; at least one."""
    return max(1, -(-drive_count // WORD_BITS))


@dataclass(frozen=True)
class VoxelBatch:
    """Consecutive blocks of a tile, in Morton order, with their voxels; field names are array names.

    Row r of block b lies in `block_start[b] : block_start[b + 1]`, counted from the batch's first voxel.
    """

    block_index: NDArray[np.int32]  # (B, 2) block column (x, y) on the city lattice
    block_start: NDArray[np.int64]  # (B + 1,)
    observed: NDArray[np.uint8]  # (B, columns, columns / 8) see `pack_columns`
    voxel: NDArray[np.uint32]  # (N,) see `pack_voxels`
    centroid: NDArray[np.uint8]  # (N, 3) in 1/256 of the voxel
    features: NDArray[np.uint8]  # (N, C) 255 = 1.0; stored coarser, see `pack_features`
    hits: NDArray[np.uint32]  # (N,) surface points averaged
    density: NDArray[np.float16]  # (N,) per metre
    rgb: NDArray[np.uint8]  # (N, 3)
    drives: NDArray[np.uint32]  # (N, words) bit d of word w: drive 32 w + d


def check_batch(batch: VoxelBatch, specs: dict[str, ArraySpec]) -> None:
    """Assert that a batch holds the arrays of `specs`, sorted: a stage that breaks this has a bug."""
    lengths = {"block": len(batch.block_index), "block edge": len(batch.block_index) + 1, "voxel": len(batch.voxel)}
    for name, spec in specs.items():
        array = getattr(batch, name)
        assert array.dtype == spec.dtype, (name, array.dtype)
        assert array.shape == (lengths[spec.rows], *spec.row_shape), (name, array.shape)
    counts = np.diff(batch.block_start)
    assert batch.block_start[0] == 0, "the first block starts at row 0"
    assert batch.block_start[-1] == len(batch.voxel), "the last block ends at the last row"
    assert (counts >= 0).all(), "blocks follow each other"
    keys = morton(batch.block_index)
    assert (keys[1:] > keys[:-1]).all(), "blocks ascend in Morton order"
    order = np.stack([np.repeat(keys, counts), batch.voxel.astype(np.uint64)])
    ascends = (order[0, 1:] > order[0, :-1]) | ((order[0, 1:] == order[0, :-1]) & (order[1, 1:] > order[1, :-1]))
    assert ascends.all(), "voxels ascend by block, then by packed voxel"


def pack_voxels(voxels: NDArray[np.int64], lattice: Lattice) -> NDArray[np.uint32]:
    """Lattice voxels (N, 3) as one word each within their block: x in bits 24-31, y in 16-23, z + 32768 in 0-15."""
    inside = np.asarray(voxels, np.int64) % [lattice.block_columns, lattice.block_columns, 1 << 62]
    x, y = inside[:, 0], inside[:, 1]
    z = np.asarray(voxels, np.int64)[:, 2] + HEIGHT_OFFSET
    return (x << 24 | y << 16 | np.clip(z, 0, 0xFFFF)).astype(np.uint32)


def unpack_voxels(packed: NDArray[np.uint32], blocks: NDArray[np.int32], lattice: Lattice) -> NDArray[np.int64]:
    """Lattice voxels (N, 3) of packed voxels (N,) in blocks (N, 2)."""
    words = packed.astype(np.int64)
    corner = blocks.astype(np.int64) * lattice.block_columns
    x, y, z = words >> 24, words >> 16 & 0xFF, (words & 0xFFFF) - HEIGHT_OFFSET
    return np.stack([corner[:, 0] + x, corner[:, 1] + y, z], -1)


def pack_features(features: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
    """Codes of features (N, C): the nearest multiple of `step`, a divisor of 255, counted in steps."""
    return ((features.astype(np.uint16) + step // 2) // step).astype(np.uint8)


def unpack_features(codes: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
    """Turns codes, in place, into features (N, C), 255 = 1.0; wrong by at most `step` // 2."""
    return np.multiply(codes, np.uint8(step), out=codes)


def pack_columns(observed: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Bits (B, columns, columns / 8) of column flags (B, x, y): bit y % 8 of byte y // 8 of row x."""
    return np.packbits(observed, axis=-1, bitorder="little")


def unpack_columns(bits: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """The inverse of `pack_columns`."""
    return np.unpackbits(bits, axis=-1, bitorder="little").astype(np.bool_)


def drive_bits(drive: int, drive_count: int) -> NDArray[np.uint32]:
    """The bit set (words,) that holds one drive."""
    words = np.zeros(word_count(drive_count), np.uint32)
    words[drive // WORD_BITS] = np.uint32(1) << np.uint32(drive % WORD_BITS)
    return words


def check_version(version: object, where: str) -> None:
    """Refuse what this program cannot read. Raises StoreError for a newer or an unreadable format version."""
    major = str(version).partition(".")[0]
    if not major.isdigit():
        raise StoreError(f"{where}: format version {version!r} is not a version; the store is damaged")
    if int(major) > FORMAT_VERSION:
        raise StoreError(
            f"{where}: format version {version} is newer than {FORMAT_VERSION}, the newest that this program reads; "
            "upgrade presight"
        )
