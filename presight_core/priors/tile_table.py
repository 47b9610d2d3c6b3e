"""One stored build of a tile: its block tables in memory, its voxels in chunks that are read when needed."""

import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from presight_core.errors import StoreError
from presight_core.grid import Lattice, morton
from presight_core.priors.chunks import CURE, ChunkCache, chunk_path, decode_chunk
from presight_core.priors.documents import CityDocument, GenerationTile
from presight_core.priors.location import ReadLocation
from presight_core.priors.schema import (
    CENTROID_STEPS,
    HEIGHT_OFFSET,
    ArraySpec,
    array_specs,
    check_version,
    drive_bits,
    unpack_columns,
    unpack_features,
    word_count,
)
from presight_core.priors.window import WindowBox

PLACE_ARRAYS = ("voxel", "centroid")  # tell where a voxel is: read first
LOOK_ARRAYS = ("features", "hits", "density", "rgb")  # read for the voxels inside the window only

Chunks = dict[tuple[str, int], NDArray]


@dataclass(frozen=True)
class TilePart:
    """The part of one tile that lies in a box."""

    columns: dict[str, NDArray]  # LOOK_ARRAYS, by name, and points_world, points_ego
    blocks: NDArray[np.int32]  # (B, 2)
    observed: NDArray[np.bool_]  # (B, columns, columns)


@dataclass(frozen=True)
class StoredArray:
    """What the tile's document says about one array."""

    spec: ArraySpec
    row_count: int
    sha256: str  # of its rows
    crc32c: Sequence[int]  # of every chunk as stored


@dataclass(frozen=True)
class TileTable:
    """One opened build of a tile."""

    name: str
    city: CityDocument
    source: ReadLocation
    cache: ChunkCache
    arrays: dict[str, StoredArray]
    drives: tuple[str, ...]  # in bit order
    block_index: NDArray[np.int32]  # (B, 2)
    block_start: NDArray[np.int64]  # (B + 1,)
    observed: NDArray[np.uint8]  # (B, columns, columns / 8) bits
    block_keys: NDArray[np.uint64]  # (B,) Morton keys, ascending

    @staticmethod
    def open(source: ReadLocation, city: CityDocument, tile: GenerationTile, cache: ChunkCache) -> "TileTable":
        """The table of a tile. Raises StoreError if a part is missing or does not fit the generation's entry."""
        name = f"{city.city}/{tile.entry.path}"
        arrays = stored_arrays(read_group(source, city, tile), city, tile, name)
        none = {
            "block_index": np.zeros((0, 2), np.int32),
            "block_start": np.zeros(0, np.int64),
            "observed": np.zeros((0, 0, 0), np.uint8),
            "block_keys": np.zeros(0, np.uint64),
        }
        closed = TileTable(name, city, source, cache, arrays, tile.entry.drives, **none)
        blocks = {key: closed.all_rows(key) for key in ("block_index", "block_start", "observed")}
        keys = morton(blocks["block_index"])
        return TileTable(name, city, source, cache, arrays, tile.entry.drives, **blocks, block_keys=keys)

    @property
    def lattice(self) -> Lattice:
        """The city's lattice."""
        return self.city.lattice

    def find(self, blocks: NDArray[np.int32]) -> NDArray[np.intp]:
        """Ascending places, in the table, of those of the given blocks (N, 2) that the tile has."""
        keys = np.sort(morton(blocks))
        places = np.searchsorted(self.block_keys, keys)
        places[places == len(self.block_keys)] = 0
        return places[self.block_keys[places] == keys] if len(self.block_keys) else places[:0]

    def read(self, box: WindowBox, blocks: NDArray[np.int32], without_drives: Collection[str] = ()) -> TilePart | None:
        """The voxels in the box, of those that other drives saw, and the observed columns of the blocks (N, 2).

        None if the tile has none of the blocks.
        """
        places = self.find(blocks)
        if not len(places):
            return None
        rows = self.rows_of(places)
        points_world = self._points(rows, places)
        points_ego, inside = box.inside(points_world)
        if not set(self.drives).isdisjoint(without_drives):
            inside &= self._seen_by_others(rows, without_drives)
        kept = np.flatnonzero(inside)
        columns = self.columns(LOOK_ARRAYS, rows[kept])
        columns |= {"points_world": points_world[kept], "points_ego": points_ego[kept].astype(np.float32)}
        return TilePart(columns, self.block_index[places], unpack_columns(self.observed[places]))

    def rows_of(self, places: NDArray[np.intp]) -> NDArray[np.int64]:
        """The rows of the voxels of the blocks at the given places."""
        counts = np.diff(self.block_start)[places]
        offsets = np.cumsum(counts) - counts
        return np.arange(counts.sum()) + np.repeat(self.block_start[places] - offsets, counts)

    def columns(self, names: Sequence[str], rows: NDArray[np.int64]) -> dict[str, NDArray]:
        """The given ascending rows of some arrays; every chunk that holds one is read once."""
        needed = {name: _chunk_edges(rows, self.arrays[name].spec.chunk_rows) for name in names}
        chunks = self.load([(name, number) for name, edges in needed.items() for number, _, _ in edges])
        return {name: self._gather(name, rows, needed[name], chunks) for name in names}

    def rows(self, name: str, rows: NDArray[np.int64]) -> NDArray:
        """The given ascending rows of one array."""
        return self.columns((name,), rows)[name]

    def all_rows(self, name: str) -> NDArray:
        """A whole array."""
        return self.rows(name, np.arange(self.arrays[name].row_count))

    def load(self, wanted: Sequence[tuple[str, int]]) -> Chunks:
        """Decoded chunks, by array and number: from the cache, or else read together."""
        found = {key: chunk for key in wanted if (chunk := self.cache.get((self.name, *key))) is not None}
        missing = [key for key in wanted if key not in found]
        paths = [f"{self.name}/{array}/{chunk_path(number, self.arrays[array].spec)}" for array, number in missing]
        for (array, number), path, content in zip(missing, paths, self.source.read_all(paths), strict=True):
            stored = self.arrays[array]
            chunk = decode_chunk(content, stored.spec, stored.crc32c[number], f"chunk {path}")
            self.cache.put((self.name, array, number), chunk)
            found[array, number] = chunk
        return found

    def warm(self, blocks: NDArray[np.int32]) -> None:
        """Read all chunks that windows over the given blocks (N, 2) may need, together, into the cache."""
        rows = self.rows_of(self.find(blocks))
        names = PLACE_ARRAYS + LOOK_ARRAYS
        self.load([(n, chunk) for n in names for chunk, _, _ in _chunk_edges(rows, self.arrays[n].spec.chunk_rows)])

    def _gather(self, name: str, rows: NDArray[np.int64], edges: list[tuple[int, int, int]], chunks: Chunks) -> NDArray:
        spec = self.arrays[name].spec
        result = np.empty((len(rows), *spec.row_shape), spec.dtype)
        for number, first, last in edges:
            local = rows[first:last] - number * spec.chunk_rows
            np.take(chunks[name, number], local, axis=0, out=result[first:last], mode="clip")  # "raise" copies twice
        return unpack_features(result, self.city.feature_step) if name == "features" else result

    def _points(self, rows: NDArray[np.int64], places: NDArray[np.intp]) -> NDArray[np.float64]:
        """World points (N, 3) of all voxels of some blocks: the middle of the centroid's quantisation step."""
        place = self.columns(PLACE_ARRAYS, rows)
        word, centroid = place["voxel"].astype(np.int64), place["centroid"]
        index = [word >> 24, word >> 16 & 0xFF, (word & 0xFFFF) - HEIGHT_OFFSET]
        counts = np.diff(self.block_start)[places]
        corners = self.lattice.voxel_min(
            np.pad(self.block_index[places] * self.lattice.block_columns, ((0, 0), (0, 1)))
        )
        points = np.empty((3, len(rows)))  # axes apart: every step below runs over one stretch of memory
        for axis in range(3):
            steps = index[axis] * CENTROID_STEPS + centroid[:, axis]
            np.multiply(steps + 0.5, self.lattice.voxel_m / CENTROID_STEPS, out=points[axis])
            points[axis] += np.repeat(corners[:, axis], counts)
        return points.T

    def _seen_by_others(self, rows: NDArray[np.int64], without_drives: Collection[str]) -> NDArray[np.bool_]:
        count = len(self.drives)
        others = [drive_bits(bit, count) for bit, drive in enumerate(self.drives) if drive not in without_drives]
        kept = np.bitwise_or.reduce([np.zeros(word_count(count), np.uint32), *others])
        return (self.rows("drives", rows) & kept).any(-1)


def read_group(source: ReadLocation, city: CityDocument, tile: GenerationTile) -> Mapping[str, Any]:
    """The attributes of a tile's group. Raises StoreError if it is missing, or not the one that was published."""
    path = f"{city.city}/{tile.entry.path}/zarr.json"
    content = source.read(path)
    if content is None:
        raise StoreError(f"{source}/{path}: the tile's data is missing, though a generation shows it; {CURE}")
    if hashlib.sha256(content).hexdigest() != tile.entry.group_sha256:
        raise StoreError(f"{source}/{path} is not the document that was published; {CURE}")
    attributes = json.loads(content)["attributes"]
    check_version(attributes["format_version"], f"{source}/{path}")
    return attributes


def stored_arrays(
    attributes: Mapping[str, Any], city: CityDocument, tile: GenerationTile, name: str
) -> dict[str, StoredArray]:
    """The arrays of a tile. Raises StoreError if they do not fit the generation's entry."""
    entry = tile.entry
    rows = {"block": entry.block_count, "block edge": entry.block_count + 1, "voxel": entry.voxel_count}
    arrays = {}
    for key, spec in array_specs(city.channel_count, len(entry.drives), city.lattice.block_columns).items():
        facts, shape = attributes["arrays"][key], [rows[spec.rows], *spec.row_shape]
        if facts["shape"] != shape or facts["dtype"] != spec.dtype:
            raise StoreError(f"{name}/{key}: {facts['dtype']}{facts['shape']}, expected {spec.dtype}{shape}; {CURE}")
        as_stored = spec.with_chunk_rows(facts["chunk_rows"])
        arrays[key] = StoredArray(as_stored, shape[0], facts["sha256"], facts["crc32c"])
    return arrays


def _chunk_edges(rows: NDArray[np.int64], chunk_rows: int) -> list[tuple[int, int, int]]:
    """Of each chunk that holds any of the ascending rows: its number, and which of the rows it holds, first to last."""
    if not len(rows):
        return []
    numbers = np.arange(rows[0] // chunk_rows, rows[-1] // chunk_rows + 1)
    edges = np.searchsorted(rows, np.append(numbers, numbers[-1] + 1) * chunk_rows)
    used = np.flatnonzero(edges[1:] > edges[:-1])
    return list(zip(numbers[used].tolist(), edges[used].tolist(), edges[used + 1].tolist(), strict=True))
