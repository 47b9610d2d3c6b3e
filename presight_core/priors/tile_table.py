"""One stored build of a tile: its block tables in memory, its voxels in chunks that are read when needed."""

import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

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
        points_world = self._points(self._spans(places))
        points_ego, inside = box.inside(points_world)
        rows = self.rows_of(places)
        if not set(self.drives).isdisjoint(without_drives):
            inside &= self.seen_by_others(rows, without_drives)
        kept = np.flatnonzero(inside)
        columns = self.columns(LOOK_ARRAYS, rows[kept])
        columns["points_world"] = np.take(points_world.T, kept, axis=1).T
        columns["points_ego"] = np.take(points_ego.T, kept, axis=1).T.astype(np.float32)
        return TilePart(columns, self.block_index[places], unpack_columns(self.observed[places]))

    def rows_of(self, places: NDArray[np.intp]) -> NDArray[np.int64]:
        """The rows of the voxels of the blocks at the given places."""
        counts = np.diff(self.block_start)[places]
        offsets = np.cumsum(counts) - counts
        return np.arange(counts.sum()) + np.repeat(self.block_start[places] - offsets, counts)

    def columns(self, names: Sequence[str], rows: NDArray[np.int64]) -> dict[str, NDArray]:
        """The given ascending rows of some arrays; every chunk that holds one is read once."""
        pieces = {size: _pieces(rows, size) for size in {self.arrays[name].spec.chunk_rows for name in names}}
        wanted = {name: pieces[self.arrays[name].spec.chunk_rows] for name in names}
        chunks = self.load([(name, piece.chunk) for name in names for piece in wanted[name]])
        return {name: self._gather(name, len(rows), wanted[name], chunks) for name in names}

    def points(self, first: int = 0, last: int | None = None) -> NDArray[np.float64]:
        """World points (N, 3), metres, of the rows from first to last, which is all of them if not given."""
        return self._points([(first, int(self.block_start[-1]) if last is None else last)])

    def rows(self, name: str, rows: NDArray[np.int64]) -> NDArray:
        """The given ascending rows of one array."""
        return self.columns((name,), rows)[name]

    def all_rows(self, name: str) -> NDArray:
        """A whole array."""
        return self.rows(name, np.arange(self.arrays[name].row_count))

    def load(self, wanted: Sequence[tuple[str, int]], keep: bool = True) -> Chunks:
        """Decoded chunks, by array and number: from the cache, or else read together, and kept there if asked."""
        found = {key: chunk for key in wanted if (chunk := self.cache.get((self.name, *key))) is not None}
        missing = [key for key in wanted if key not in found]
        paths = [f"{self.name}/{array}/{chunk_path(number, self.arrays[array].spec)}" for array, number in missing]
        for (array, number), path, content in zip(missing, paths, self.source.read_all(paths), strict=True):
            stored = self.arrays[array]
            chunk = decode_chunk(content, stored.spec, stored.crc32c[number], f"chunk {path}")
            if keep:
                self.cache.put((self.name, array, number), chunk)
            found[array, number] = chunk
        return found

    def warm(self, blocks: NDArray[np.int32]) -> None:
        """Read all chunks that windows over the given blocks (N, 2) may need, together, into the cache."""
        places = self.find(blocks)
        self._points(self._spans(places))
        rows, size_of = self.rows_of(places), {name: self.arrays[name].spec.chunk_rows for name in LOOK_ARRAYS}
        self.load([(name, piece.chunk) for name, size in size_of.items() for piece in _pieces(rows, size)])

    def seen_by_others(self, rows: NDArray[np.int64], without_drives: Collection[str]) -> NDArray[np.bool_]:
        """Which of the given ascending rows some other drive than these saw."""
        count = len(self.drives)
        others = [drive_bits(bit, count) for bit, drive in enumerate(self.drives) if drive not in without_drives]
        kept = np.bitwise_or.reduce([np.zeros(word_count(count), np.uint32), *others])
        return (self.rows("drives", rows) & kept).any(-1)

    def _gather(self, name: str, count: int, pieces: list["_Piece"], chunks: Chunks) -> NDArray:
        spec = self.arrays[name].spec
        result = np.empty((count, *spec.row_shape), spec.dtype)
        for piece in pieces:
            # mode="raise" would copy twice
            np.take(chunks[name, piece.chunk], piece.rows, axis=0, out=result[piece.first : piece.last], mode="clip")
        if name == "features":
            unpack_features(result, self.city.feature_step)
        return result

    def _spans(self, places: NDArray[np.intp]) -> list[tuple[int, int]]:
        """First and end rows of the blocks at the given places, those of neighbours in the table as one."""
        first, last = self.block_start[places], self.block_start[places + 1]
        breaks = np.flatnonzero(first[1:] != last[:-1])
        starts, ends = np.append(first[:1], first[breaks + 1]), np.append(last[breaks], last[-1:])
        return [(start, end) for start, end in zip(starts.tolist(), ends.tolist(), strict=True) if end > start]

    def _points(self, spans: list[tuple[int, int]]) -> NDArray[np.float64]:
        """World points (N, 3), metres, of the rows of some spans."""
        size = self.arrays["voxel"].spec.chunk_rows
        pieces = [
            (number, max(first - number * size, 0), min(last - number * size, size))
            for first, last in spans
            for number in range(first // size, -(-last // size))
        ]
        chunks = self._point_chunks([number for number, _, _ in pieces])
        parts = [chunks[number][:, first:last] for number, first, last in pieces]
        return np.concatenate([np.empty((3, 0)), *parts], axis=1).T

    def _point_chunks(self, numbers: Sequence[int]) -> dict[int, NDArray[np.float64]]:
        """World points (3, rows) of whole chunks: kept in the place of the two arrays that they are made from."""
        kept = {number: self.cache.get((self.name, "points", number)) for number in numbers}
        found = {number: points for number, points in kept.items() if points is not None}
        missing = sorted(kept.keys() - found)
        stored = self.load([(name, number) for name in PLACE_ARRAYS for number in missing], keep=False)
        for number in missing:
            found[number] = self._chunk_points(number, stored["voxel", number], stored["centroid", number])
            self.cache.put((self.name, "points", number), found[number])
        return found

    def _chunk_points(self, number: int, word: NDArray[np.uint32], centroid: NDArray[np.uint8]) -> NDArray[np.float64]:
        """World points (3, rows) of a chunk: the middle of the centroid's quantisation step.

        Axes are apart, so that every step runs over one stretch of memory.
        """
        first, last = number * len(word), min((number + 1) * len(word), int(self.block_start[-1]))
        low, high = np.searchsorted(self.block_start, [first, last - 1], side="right")  # the blocks it cuts or holds
        counts = np.diff(np.clip(self.block_start[low - 1 : high + 1], first, last))
        corners = self.block_index[low - 1 : high] * self.lattice.block_m + self.lattice.origin_m[:2]
        word, centroid = word[: last - first], centroid[: last - first]
        step_m = self.lattice.voxel_m / CENTROID_STEPS
        points = np.empty((3, last - first))
        for axis, voxel in enumerate([word >> 24, word >> 16 & 0xFF, word & 0xFFFF]):
            np.multiply(voxel * np.uint32(CENTROID_STEPS) + centroid[:, axis], step_m, out=points[axis])
        points[:2] += np.repeat(corners + step_m / 2, counts, axis=0).T
        points[2] += self.lattice.origin_m[2] - HEIGHT_OFFSET * self.lattice.voxel_m + step_m / 2
        return points


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


class _Piece(NamedTuple):
    """The wanted rows that lie in one chunk."""

    chunk: int
    rows: NDArray[np.int64]  # counted from the chunk's first one
    first: int  # and their places among all wanted rows
    last: int


def _pieces(rows: NDArray[np.int64], chunk_rows: int) -> list[_Piece]:
    """Ascending rows, by the chunk that holds them."""
    if not len(rows):
        return []
    chunks = np.arange(rows[0] // chunk_rows, rows[-1] // chunk_rows + 1)
    edges = np.searchsorted(rows, np.append(chunks, chunks[-1] + 1) * chunk_rows).tolist()
    spans = zip(chunks.tolist(), edges[:-1], edges[1:], strict=True)
    return [_Piece(c, rows[first:last] - c * chunk_rows, first, last) for c, first, last in spans if last > first]
