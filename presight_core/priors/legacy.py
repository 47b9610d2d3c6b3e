"""The pickles of the released PreSight code: written for its configurations, and read without executing anything.

One pickle a tile: points (float32, relative to `origin`), features (float16), colors (float32), hits (int64).
Their frame is the world after half a turn about z: the released loader adds the origin and negates x and y.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from pickle import Unpickler, UnpicklingError, _Pickler
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from presight_core.errors import InputError
from presight_core.grid import Lattice, morton
from presight_core.priors.reader import PriorReader
from presight_core.priors.schema import VoxelBatch, pack_columns, pack_voxels

# How many pickles the released configurations expect of each city.
PART_COUNTS = {
    "boston-seaport": 8,
    "singapore-onenorth": 4,
    "singapore-queenstown": 4,
    "singapore-hollandvillage": 2,
}
TURNED = np.array([-1.0, -1.0, 1.0])  # world axes in the frame of the pickles
OLD_NAME = b"cnumpy.core.multiarray\n_reconstruct\n"  # by the opcode GLOBAL
PROTOCOL = 4  # the first for arrays above 4 GiB; Python 3.8 reads it
BLOCKS_PER_BATCH = 256  # about 250,000 voxels: 100 MB while they are averaged
CURE = "pass the released <city>-c<i>.pkl files"
_RECONSTRUCT = np.zeros(0).__reduce__()[0]  # what numpy names in pickles of arrays
_MODULES = ("numpy.core.multiarray", "numpy._core.multiarray")  # its home before and after numpy 2
_BUFFER_MODULES = ("numpy.core.numeric", "numpy._core.numeric")
ALLOWED = {
    **{(module, "_reconstruct"): _RECONSTRUCT for module in _MODULES},
    **{(module, "_frombuffer"): np.zeros(0).__reduce_ex__(5)[0] for module in _BUFFER_MODULES},
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
}


@dataclass(frozen=True)
class LegacyTile:
    """Voxels of one pickle."""

    points_world: NDArray[np.float64]  # (N, 3) metres
    features: NDArray[np.float16]  # (N, C) 0..1
    hits: NDArray[np.int64]  # (N,)
    colours: NDArray[np.float32]  # (N, 3) 0..1


def write_legacy(reader: PriorReader, folder: Path) -> list[Path]:
    """Write a city as `<city>-c<i>.pkl` into a folder; the files.

    There is one for each tile, or as many as the released configurations expect of the city: then all voxels,
    in the order of the tiles, are cut evenly.
    """
    city = reader.generation.city
    tables = [reader.tile(tile_id) for tile_id in reader.tiles]
    ends = np.cumsum([int(table.block_start[-1]) for table in tables])
    part_count = PART_COUNTS.get(city, len(tables))
    if part_count != len(tables):
        ends = np.round(np.linspace(0, ends[-1] if len(ends) else 0, part_count + 1)).astype(np.int64)[1:]
    files = []
    for number, (first, last) in enumerate(zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True)):
        files.append(folder / f"{city}-c{number}.pkl")
        with files[-1].open("wb") as file:
            _ReleasedPickler(file, PROTOCOL).dump(_part(reader, first, last))
    return files


def read_legacy(file: Path) -> LegacyTile:
    """The voxels of a pickle. Raises InputError if it is anything but numeric arrays in a dict; nothing is executed."""
    try:
        with file.open("rb") as opened:
            value = _ArraysOnly(opened).load()
    except (
        UnpicklingError,
        EOFError,
        ValueError,
        TypeError,
        AttributeError,
        KeyError,
        IndexError,
        MemoryError,
    ) as error:
        raise InputError(
            f"{file}: not a pickle of arrays ({error}); pass the released <city>-c<i>.pkl files"
        ) from error
    if not isinstance(value, dict):
        raise InputError(f"{file}: holds a {type(value).__name__}; pass the released <city>-c<i>.pkl files")
    points, features, hits, colours, origin = (
        _array(file, value, name, kinds, shape)
        for name, kinds, shape in [
            ("points", "f", (-1, 3)),
            ("features", "f", (-1, -1)),
            ("hits", "iu", (-1,)),
            ("colors", "f", (-1, 3)),
            ("origin", "f", (-1,)),
        ]
    )
    lengths = {len(points), len(features), len(hits), len(colours)}
    if len(lengths) > 1 or origin.size != 3 or (hits < 1).any() or not np.isfinite(points).all():
        raise InputError(f"{file}: its arrays do not fit together, {sorted(lengths)} rows; {CURE}")
    world = (points.astype(np.float64) + origin.reshape(3)) * TURNED
    return LegacyTile(world, features.astype(np.float16), hits.astype(np.int64), colours.astype(np.float32))


def legacy_batches(tiles: list[LegacyTile], lattice: Lattice) -> list[Iterator[VoxelBatch]]:
    """The same tiles on a city's lattice. Voxels that meet in one of its voxels are averaged by their hits.

    A block goes to the tile whose mean is the nearest, so that none is stored twice. The pickles know neither
    density, which becomes 0, nor columns that rays passed through: only columns with voxels count as observed.
    """
    whole = LegacyTile(
        *(np.concatenate([getattr(tile, name) for tile in tiles]) for name in LegacyTile.__annotations__)
    )
    blocks = lattice.block_of(lattice.voxel_of(whole.points_world))
    centroids = np.array([tile.points_world[:, :2].mean(0) for tile in tiles])
    distance = np.linalg.norm(lattice.block_centre(blocks)[:, None] - centroids, axis=-1)
    owner = distance.argmin(1)
    return [_batches(whole, np.flatnonzero(owner == number), lattice) for number in range(len(tiles))]


def _part(reader: PriorReader, first: int, last: int) -> dict[str, NDArray]:
    """One pickle's arrays: rows first to last of all tiles, one after the other."""
    parts, start = [], 0
    for tile_id in reader.tiles:
        table = reader.tile(tile_id)
        low, high = np.clip([first - start, last - start], 0, int(table.block_start[-1])).tolist()
        start += int(table.block_start[-1])
        if high > low:
            parts.append((table.points(low, high), table.columns(("features", "rgb", "hits"), np.arange(low, high))))
    points = np.concatenate([np.zeros((0, 3)), *(points for points, _ in parts)]) * TURNED
    origin = np.round(points.mean(0)).astype(np.float32) if len(points) else np.zeros(3, np.float32)
    features = np.concatenate([np.zeros((0, reader.channel_count), np.uint8), *(row["features"] for _, row in parts)])
    rgb = np.concatenate([np.zeros((0, 3), np.uint8), *(row["rgb"] for _, row in parts)])
    return {
        "points": (points - origin).astype(np.float32),
        "features": (features / np.float32(255)).astype(np.float16),
        "colors": (rgb / np.float32(255)).astype(np.float32),
        "hits": np.concatenate([np.zeros(0, np.int64), *(row["hits"].astype(np.int64) for _, row in parts)]),
        "origin": origin,
    }


class _ReleasedPickler(_Pickler):
    """Names numpy's function as numpy 1 does, which is what the released environments have."""

    def save_global(self, obj: Any, name: str | None = None) -> None:
        if obj is _RECONSTRUCT:
            self.write(OLD_NAME)  # pyright: ignore[reportAttributeAccessIssue] - the stubs hide what pickle.py has
            self.memoize(obj)  # pyright: ignore[reportAttributeAccessIssue]
        else:
            super().save_global(obj, name)  # pyright: ignore[reportAttributeAccessIssue]


class _ArraysOnly(Unpickler):
    """Knows arrays and nothing else: whatever other name a pickle asks for is refused, not imported."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in ALLOWED:
            raise UnpicklingError(f"asks for {module}.{name}, which is no array")
        return ALLOWED[module, name]


def _array(file: Path, value: dict, name: str, kinds: str, shape: tuple[int, ...]) -> NDArray:
    array = value.get(name)
    array = array.reshape(-1) if name == "origin" and isinstance(array, np.ndarray) else array
    fits = (
        isinstance(array, np.ndarray)
        and array.dtype.kind in kinds
        and array.ndim == len(shape)
        and all(want in {-1, have} for want, have in zip(shape, array.shape, strict=True))
    )
    if not fits:
        found = f"{array.dtype}{array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
        raise InputError(f"{file}: {name} is {found}; {CURE}")
    return cast("NDArray", array)


def _batches(tile: LegacyTile, rows: NDArray[np.intp], lattice: Lattice) -> Iterator[VoxelBatch]:
    """Batches of the given rows, in Morton order."""
    voxels = lattice.voxel_of(tile.points_world[rows])
    blocks, packed = lattice.block_of(voxels), pack_voxels(voxels, lattice)
    keys = morton(blocks)
    order = np.lexsort((packed, keys))
    rows, blocks, packed, keys = rows[order], blocks[order], packed[order], keys[order]
    starts = np.append(np.flatnonzero(np.diff(keys, prepend=keys[:1] + np.uint64(1))), len(keys))  # of blocks
    for number in range(0, len(starts) - 1, BLOCKS_PER_BATCH):
        edges = starts[number : number + BLOCKS_PER_BATCH + 1]
        part = slice(int(edges[0]), int(edges[-1]))
        yield _batch(tile, rows[part], blocks[part], packed[part], lattice)


def _batch(
    tile: LegacyTile, rows: NDArray[np.intp], blocks: NDArray[np.int32], packed: NDArray[np.uint32], lattice: Lattice
) -> VoxelBatch:
    """One batch of sorted rows: those of one voxel become one, weighted by their hits."""
    change = np.any(np.diff(blocks, axis=0, prepend=blocks[:1]) != 0, -1)
    firsts = np.flatnonzero(change | (np.diff(packed.astype(np.int64), prepend=-1) != 0))
    hits = np.add.reduceat(tile.hits[rows], firsts)
    weights = (tile.hits[rows] / np.repeat(hits, np.diff(np.append(firsts, len(rows)))))[:, None]

    def mean(column: NDArray) -> NDArray:
        return np.add.reduceat(column[rows] * weights, firsts, axis=0)

    corners = lattice.voxel_min(lattice.voxel_of(tile.points_world[rows[firsts]]))
    inside = (mean(tile.points_world) - corners) / lattice.voxel_m
    block_firsts = np.flatnonzero(np.any(np.diff(blocks[firsts], axis=0, prepend=blocks[:1] - 1) != 0, -1))
    voxel = packed[firsts]
    observed = np.zeros((len(block_firsts), lattice.block_columns, lattice.block_columns), np.bool_)
    block_of_row = np.repeat(np.arange(len(block_firsts)), np.diff(np.append(block_firsts, len(voxel))))
    observed[block_of_row, voxel >> 24, voxel >> 16 & 0xFF] = True
    return VoxelBatch(
        block_index=blocks[firsts][block_firsts],
        block_start=np.append(block_firsts, len(voxel)).astype(np.int64),
        observed=pack_columns(observed),
        voxel=voxel,
        centroid=np.clip(np.floor(inside * 256), 0, 255).astype(np.uint8),
        features=np.round(np.clip(mean(tile.features.astype(np.float32)), 0, 1) * 255).astype(np.uint8),
        hits=np.minimum(hits, np.iinfo(np.uint32).max).astype(np.uint32),
        density=np.zeros(len(voxel), np.float16),
        rgb=np.round(np.clip(mean(tile.colours), 0, 1) * 255).astype(np.uint8),
        drives=np.ones((len(voxel), 1), np.uint32),
    )
