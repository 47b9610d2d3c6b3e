"""Reads the prior around a vehicle from a store: only the blocks it needs, only numpy, zarr and obstore."""

import os
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import ArrayLike, NDArray
from zarr.abc.store import Store

from presight_core.errors import NotFoundError, StoreError
from presight_core.grid import Lattice
from presight_core.priors.documents import (
    GENERATION_FILE,
    CityDocument,
    Generation,
    GenerationTile,
    city_path,
    decode,
    generation_path,
    generations_path,
)
from presight_core.priors.location import ReadLocation
from presight_core.priors.schema import (
    CENTROID_STEPS,
    array_specs,
    drive_bits,
    unpack_columns,
    unpack_voxels,
    word_count,
)
from presight_core.priors.window import Range, Window, WindowBox

VOXEL_ARRAYS = ("voxel", "centroid", "features", "hits", "density", "rgb")
CURE = "restore the store from a copy, or rebuild the tile and publish again"


class PriorReader:
    """A city's priors at one generation, pinned. Can be pickled, and used after a fork of the process."""

    def __init__(self, location: str | Path, city: CityDocument, generation: Generation) -> None:
        self._location = location
        self._city = city
        self.generation = generation
        self._tables: dict[str, TileTable] = {}
        self._pid = os.getpid()

    @staticmethod
    def open(location: str | Path, city: str, generation: int | None = None) -> "PriorReader":
        """The reader of a city in the store at `location` (folder or URL); the newest generation unless given.

        Raises NotFoundError if the city or generation is not there, StoreError if it is damaged or newer
        than this program, or if its tiles are in different feature spaces.
        """
        source = ReadLocation(location)
        return PriorReader(location, read_city(source, city), read_generation(source, city, generation))

    @property
    def tiles(self) -> tuple[str, ...]:
        """Ids of the tiles that the generation shows."""
        return tuple(sorted(self.generation.tiles))

    @property
    def channel_count(self) -> int:
        """C, the feature channels of every voxel."""
        return self._city.channel_count

    @property
    def lattice(self) -> Lattice:
        """The city's lattice."""
        return self._city.lattice

    @property
    def space_id(self) -> str:
        """The feature space of every voxel."""
        return self._city.space_id

    @property
    def drive_names(self) -> dict[str, str]:
        """Scene names of the drives in the prior, by drive id; "" for drives published without a name."""
        return {
            drive: tile.lineage.get("drive_names", {}).get(drive, "")
            for tile in self.generation.tiles.values()
            for drive in tile.entry.drives
        }

    def window(
        self,
        world_from_ego: ArrayLike,
        x_m: Range = (-50.0, 50.0),
        y_m: Range = (-25.0, 25.0),
        z_m: Range = (-3.0, 5.0),
        without_drives: Collection[str] = (),
    ) -> Window:
        """The prior in the given box of the ego frame, metres; empty outside the city.

        without_drives: voxels that no other drive saw are left out; the others keep what all drives made of them.
        Raises InputError for a pose that is not rigid, StoreError if stored data is lost or damaged.
        """
        box = WindowBox.at(world_from_ego, x_m, y_m, z_m)
        tiles = [tile_id for tile_id in self.tiles if _may_meet(box, self.generation.tiles[tile_id], self.lattice)]
        parts = {
            tile_id: part for tile_id in tiles if (part := self.tile(tile_id).read(box, without_drives)) is not None
        }
        return _window(box, self.lattice, self.channel_count, parts)

    def tile(self, tile_id: str) -> "TileTable":
        """One tile's table, opened when first asked for. Raises NotFoundError for a tile not in the generation."""
        if self._pid != os.getpid():  # a fork: open anew, and share no file or connection with the parent
            self._tables, self._pid = {}, os.getpid()
        if tile_id not in self.generation.tiles:
            raise NotFoundError(f"{self._city.city} generation {self.generation.number} has no tile {tile_id}")
        if tile_id not in self._tables:
            store = ReadLocation(self._location).zarr_store()
            self._tables[tile_id] = TileTable.open(store, self._city, self.generation.tiles[tile_id])
        return self._tables[tile_id]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_tables": {}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _pid=os.getpid())


@dataclass(frozen=True)
class TilePart:
    """The part of one tile that lies in a box."""

    columns: dict[str, NDArray]  # the voxel arrays, by name, and points_world, points_ego
    blocks: NDArray[np.int32]  # (B, 2)
    observed: NDArray[np.bool_]  # (B, columns, columns)


@dataclass(frozen=True)
class TileTable:
    """One opened build of a tile: its block tables in memory, its voxels in the store."""

    name: str
    lattice: Lattice
    arrays: dict[str, zarr.Array]
    block_index: NDArray[np.int32]  # (B, 2)
    block_start: NDArray[np.int64]  # (B + 1,)
    drives: tuple[str, ...]  # in bit order

    @staticmethod
    def open(store: Store, city: CityDocument, tile: GenerationTile) -> "TileTable":
        """The table of a tile. Raises StoreError if an array is missing or does not fit the generation's entry."""
        entry, name = tile.entry, f"{city.city}/{tile.entry.path}"
        specs = array_specs(city.channel_count, len(entry.drives), city.lattice.block_columns)
        with _naming(name):
            arrays = {key: zarr.open_array(store, path=f"{name}/{key}", mode="r", zarr_format=3) for key in specs}
            block_index = np.asarray(arrays["block_index"][:])
            block_start = np.asarray(arrays["block_start"][:])
        rows = {"block": entry.block_count, "block edge": entry.block_count + 1, "voxel": entry.voxel_count}
        for key, spec in specs.items():
            expected = (rows[spec.rows], *spec.row_shape)
            if arrays[key].shape != expected or arrays[key].dtype != spec.dtype:
                raise StoreError(
                    f"{name}/{key}: {arrays[key].dtype}{arrays[key].shape}, expected {spec.dtype}{expected}"
                )
        return TileTable(name, city.lattice, arrays, block_index, block_start, entry.drives)

    def read(self, box: WindowBox, without_drives: Collection[str] = ()) -> TilePart | None:
        """The voxels, of those that other drives saw, and observed columns in the box; None if no block meets it."""
        blocks = np.flatnonzero(box.meets(self.block_index, self.lattice))
        if not len(blocks):
            return None
        counts = np.diff(self.block_start)[blocks]
        rows = _ranges(self.block_start[blocks], counts)
        columns = {name: self.rows(name, rows) for name in VOXEL_ARRAYS}
        block_of_row = np.repeat(self.block_index[blocks], counts, axis=0)
        points_world = _points(columns["voxel"], columns["centroid"], block_of_row, self.lattice)
        points_ego, inside = box.inside(points_world)
        if not set(self.drives).isdisjoint(without_drives):
            inside &= self._seen_by_others(rows, without_drives)
        columns |= {"points_world": points_world, "points_ego": points_ego.astype(np.float32)}
        observed = unpack_columns(self.rows("observed", blocks))
        return TilePart({name: column[inside] for name, column in columns.items()}, self.block_index[blocks], observed)

    def rows(self, name: str, rows: NDArray[np.int64]) -> NDArray:
        """The given ascending rows of an array; every chunk that holds one is read once."""
        array = self.arrays[name]
        result = np.empty((len(rows), *array.shape[1:]), array.dtype)
        for first, last in _chunk_runs(rows, array.chunks[0]):
            low, high = np.searchsorted(rows, [first, last])
            with _naming(f"{self.name}/{name}"):
                result[low:high] = np.asarray(array[first : min(last, array.shape[0])])[rows[low:high] - first]
        return result

    def _seen_by_others(self, rows: NDArray[np.int64], without_drives: Collection[str]) -> NDArray[np.bool_]:
        count = len(self.drives)
        others = [drive_bits(bit, count) for bit, drive in enumerate(self.drives) if drive not in without_drives]
        kept = np.bitwise_or.reduce([np.zeros(word_count(count), np.uint32), *others])
        return (self.rows("drives", rows) & kept).any(-1)

    def all_rows(self, name: str) -> NDArray:
        """A whole array."""
        return self.rows(name, np.arange(self.arrays[name].shape[0]))


def read_city(source: ReadLocation, city: str) -> CityDocument:
    """The fixed facts of a city. Raises NotFoundError if the store has no such city."""
    path = city_path(city)
    content = source.read(path)
    if content is None:
        raise NotFoundError(f"{source} has no priors of {city}; build the city, or check the location and the name")
    return decode(content, f"{source}/{path}", CityDocument.from_json)


def generation_numbers(source: ReadLocation, city: str) -> list[int]:
    """Numbers of a city's generations, ascending."""
    matches = (GENERATION_FILE.fullmatch(name) for name in source.names(generations_path(city)))
    return sorted(int(match[1]) for match in matches if match)


def read_generation(source: ReadLocation, city: str, number: int | None) -> Generation:
    """A generation of a city, the newest for None. Raises NotFoundError if there is none, StoreError if unreadable."""
    if number is None:
        numbers = generation_numbers(source, city)
        if not numbers:
            raise NotFoundError(f"{source} has no published generation of {city}; build the city first")
        number = numbers[-1]
    path = generation_path(city, number)
    content = source.read(path)
    if content is None:
        raise NotFoundError(f"{source} has no generation {number} of {city}; ask for one that was published")
    generation = decode(content, f"{source}/{path}", Generation.from_json)
    spaces = {generation.space_id} | {tile.entry.space_id for tile in generation.tiles.values()}
    if len(spaces) > 1:
        raise StoreError(f"{source}/{path}: tiles of different feature spaces {sorted(spaces)}; rebuild the older ones")
    return generation


def _may_meet(box: WindowBox, tile: GenerationTile, lattice: Lattice) -> bool:
    (left, bottom), (right, top) = box.block_range(lattice)
    least_x, least_y, greatest_x, greatest_y = tile.entry.block_bounds
    apart = left > greatest_x or bottom > greatest_y or right < least_x or top < least_y
    return tile.entry.block_count > 0 and not bool(apart)


def _points(
    packed: NDArray[np.uint32], centroid: NDArray[np.uint8], blocks: NDArray[np.int32], lattice: Lattice
) -> NDArray[np.float64]:
    """World points (N, 3): the middle of the centroid's quantisation step."""
    corner = lattice.voxel_min(unpack_voxels(packed, blocks, lattice))
    return corner + (centroid + 0.5) * (lattice.voxel_m / CENTROID_STEPS)


def _window(box: WindowBox, lattice: Lattice, channel_count: int, parts: dict[str, TilePart]) -> Window:
    least, greatest = box.block_range(lattice)
    size = lattice.block_columns
    observed = np.zeros((greatest - least + 1) * size, np.bool_)
    for part in parts.values():
        for (x, y), flags in zip((part.blocks - least) * size, part.observed, strict=True):
            observed[x : x + size, y : y + size] |= flags
    origin = least * size
    columns = np.stack(np.meshgrid(*(np.arange(n) for n in observed.shape), indexing="ij"), -1).reshape(-1, 2) + origin
    ground = box.ground(columns, lattice).reshape(observed.shape)
    observed &= ground
    return Window(
        **_joined(channel_count, parts),
        observed=observed,
        observed_origin=(int(origin[0]), int(origin[1])),
        coverage=float(observed.sum() / max(1, ground.sum())),
        tiles=tuple(parts),
    )


def _joined(channel_count: int, parts: dict[str, TilePart]) -> dict[str, NDArray]:
    """The voxel columns of all parts, one after the other; typed also when there are none."""
    specs = array_specs(channel_count, 0, 8)
    empty = {name: np.zeros((0, *specs[name].row_shape), specs[name].dtype) for name in VOXEL_ARRAYS[2:]}
    empty |= {"points_ego": np.zeros((0, 3), np.float32), "points_world": np.zeros((0, 3))}
    found = parts.values()
    return {name: np.concatenate([none, *(part.columns[name] for part in found)]) for name, none in empty.items()}


def _ranges(starts: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """start, start + 1, ..., start + count - 1 of every range, one after the other."""
    offsets = np.cumsum(counts) - counts
    return np.arange(counts.sum()) + np.repeat(starts - offsets, counts)


def _chunk_runs(rows: NDArray[np.int64], chunk: int) -> Iterator[tuple[int, int]]:
    """First row and end row of each run of neighbouring chunks that hold any of the ascending rows."""
    chunks = rows // chunk
    chunks = chunks[np.flatnonzero(np.diff(chunks, prepend=-1))]
    for run in np.split(chunks, np.flatnonzero(np.diff(chunks) > 1) + 1):
        if len(run):
            yield int(run[0]) * chunk, (int(run[-1]) + 1) * chunk


@contextmanager
def _naming(name: str) -> Iterator[None]:
    """Turns whatever a damaged array raises into a StoreError that names it."""
    try:
        yield
    except Exception as error:
        raise StoreError(f"{name} is damaged or cannot be read: {error}; {CURE}") from error
