"""Reads the prior around a vehicle from a store: only the chunks it needs, and no Zarr library."""

import os
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from presight_core.errors import NotFoundError, StoreError
from presight_core.grid import Lattice
from presight_core.priors.chunks import ChunkCache
from presight_core.priors.documents import (
    GENERATION_FILE,
    CityDocument,
    Generation,
    GenerationTile,
    city_path,
    decode,
    generation_path,
    generations_path,
    tag_path,
)
from presight_core.priors.location import ReadLocation
from presight_core.priors.schema import array_specs
from presight_core.priors.tile_table import LOOK_ARRAYS, TilePart, TileTable
from presight_core.priors.window import Range, Window, WindowBox

CACHE_BYTES = 128 << 20  # of decoded chunks in each reader, so in each worker of a data loader: 1.5 million voxels


class CollectedError(NotFoundError):
    """The generation that a reader pinned was removed by `presight gc`; open another one."""


class PriorReader:
    """A city's priors at one generation, pinned. Can be pickled, and used after a fork of the process."""

    def __init__(
        self, location: str | Path, city: CityDocument, generation: Generation, cache_bytes: int = CACHE_BYTES
    ) -> None:
        self._location = location
        self._city = city
        self._cache_bytes = cache_bytes
        self._unbuilt = _unbuilt_tiles(generation)
        self.generation = generation
        self._start()

    @staticmethod
    def open(
        location: str | Path, city: str, generation: int | str | None = None, cache_bytes: int = CACHE_BYTES
    ) -> "PriorReader":
        """The reader of a city in the store at `location` (folder or URL).

        generation: a number or a tag; the newest if not given.
        cache_bytes: decoded chunks that the reader may keep, so that windows nearby are read once. Beside them
        it holds about 150 bytes of tables for every block of 32 x 32 columns in the tiles it has met.

        Raises NotFoundError if the city or generation is not there, StoreError if it is damaged or newer
        than this program, or if its tiles are in different feature spaces.
        """
        source = ReadLocation(location)
        return PriorReader(location, read_city(source, city), read_generation(source, city, generation), cache_bytes)

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
        Raises InputError for a pose that is not rigid, StoreError if stored data is lost or damaged, CollectedError
        if it is gone because the generation was removed.
        """
        return self._window(WindowBox.at(world_from_ego, x_m, y_m, z_m), without_drives)

    def windows(
        self,
        world_from_ego: Sequence[ArrayLike],
        x_m: Range = (-50.0, 50.0),
        y_m: Range = (-25.0, 25.0),
        z_m: Range = (-3.0, 5.0),
        without_drives: Collection[str] = (),
    ) -> list[Window]:
        """The same as `window`, at several poses. From an object store, all that they need is fetched side by side.

        That takes a `cache_bytes` that holds the chunks of the batch.
        """
        boxes = [WindowBox.at(pose, x_m, y_m, z_m) for pose in world_from_ego]
        if boxes and ReadLocation(self._location).is_remote:
            blocks = np.unique(np.concatenate([box.blocks(self.lattice) for box in boxes]), axis=0)
            with self._told_when_collected():
                for tile_id in self._tiles_with(blocks):
                    self.tile(tile_id).warm(blocks)
        return [self._window(box, without_drives) for box in boxes]

    def tile(self, tile_id: str) -> TileTable:
        """One tile's table, opened when first asked for. Raises NotFoundError for a tile not in the generation."""
        if self._pid != os.getpid():  # a fork: share no connection and no lock with the parent
            self._start()
        if tile_id not in self.generation.tiles:
            raise NotFoundError(f"{self._city.city} generation {self.generation.number} has no tile {tile_id}")
        if tile_id not in self._tables:
            tile = self.generation.tiles[tile_id]
            with self._told_when_collected():
                self._tables[tile_id] = TileTable.open(ReadLocation(self._location), self._city, tile, self._cache)
        return self._tables[tile_id]

    @contextmanager
    def _told_when_collected(self) -> Iterator[None]:
        """Say so if what cannot be read is gone because `presight gc` removed the generation meanwhile."""
        try:
            yield
        except StoreError as error:
            city, number = self._city.city, self.generation.number
            path = generation_path(city, number)
            if number == 0 or ReadLocation(self._location).read(path) is not None:
                raise
            raise CollectedError(
                f"{city}: generation {number} was removed while it was read; open the newest one, and tag the "
                f"generation of a long run: presight tag {city} NAME --generation N"
            ) from error

    def _window(self, box: WindowBox, without_drives: Collection[str]) -> Window:
        blocks = box.blocks(self.lattice)
        with self._told_when_collected():
            parts = {
                tile_id: part
                for tile_id in self._tiles_with(blocks)
                if (part := self.tile(tile_id).read(box, blocks, without_drives)) is not None
            }
        missing = self._missing_tiles(box) if self._unbuilt else ()
        return _window(box, self.lattice, self.channel_count, parts, missing)

    def _tiles_with(self, blocks: NDArray[np.int32]) -> list[str]:
        """Tiles whose bounds meet those of the blocks (N, 2)."""
        if not len(blocks):
            return []
        least, greatest = blocks.min(0).tolist(), blocks.max(0).tolist()
        return [tile_id for tile_id in self.tiles if _may_meet(self.generation.tiles[tile_id], least, greatest)]

    def _missing_tiles(self, box: WindowBox) -> tuple[str, ...]:
        """Tiles without a build whose centroid is the nearest one to the box's middle or to one of its corners."""
        names = [tile["tile_id"] for tile in self.generation.tiling["tiles"]]
        centroids = np.array([tile["centroid_m"] for tile in self.generation.tiling["tiles"]])
        places = np.vstack([box.corners_world[:, :2], box.corners_world[:, :2].mean(0)])
        nearest = np.linalg.norm(places[:, None] - centroids, axis=-1).argmin(1)
        return tuple(sorted({names[place] for place in nearest} & self._unbuilt))

    def forget(self) -> None:
        """Let go of every decoded chunk, to give the memory back; the tables of blocks stay."""
        self._cache.clear()

    def _start(self) -> None:
        self._tables: dict[str, TileTable] = {}
        self._cache = ChunkCache(self._cache_bytes)
        self._pid = os.getpid()

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in {"_tables", "_cache", "_pid"}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._start()


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


def read_generation(source: ReadLocation, city: str, number: int | str | None) -> Generation:
    """A generation of a city, by number or tag, the newest for None.

    Raises NotFoundError if there is none, StoreError if it is unreadable.
    """
    if isinstance(number, str):
        number = read_tag(source, city, number)
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
    if (generation.number, generation.city) != (number, city):
        raise StoreError(
            f"{source}/{path} holds generation {generation.number} of {generation.city}; restore it from a copy"
        )
    spaces = {generation.space_id} | {tile.entry.space_id for tile in generation.tiles.values()}
    if len(spaces) > 1:
        raise StoreError(f"{source}/{path}: tiles of different feature spaces {sorted(spaces)}; rebuild the older ones")
    return generation


def read_tag(source: ReadLocation, city: str, tag: str) -> int:
    """The generation that a tag names. Raises NotFoundError if there is no such tag."""
    path = tag_path(city, tag)
    content = source.read(path)
    if content is None:
        raise NotFoundError(f"{source} has no tag {tag} of {city}; set it with `presight tag`")
    return decode(content, f"{source}/{path}", lambda value: int(value["generation"]))


def _may_meet(tile: GenerationTile, least: list[int], greatest: list[int]) -> bool:
    left, bottom, right, top = tile.entry.block_bounds
    apart = least[0] > right or least[1] > top or greatest[0] < left or greatest[1] < bottom
    return tile.entry.block_count > 0 and not apart


def _unbuilt_tiles(generation: Generation) -> frozenset[str]:
    return frozenset(tile["tile_id"] for tile in generation.tiling.get("tiles", ())) - generation.tiles.keys()


def _window(
    box: WindowBox, lattice: Lattice, channel_count: int, parts: dict[str, TilePart], missing: tuple[str, ...]
) -> Window:
    least, greatest = box.block_range(lattice)
    size = lattice.block_columns
    width, height = ((greatest - least + 1) * size).tolist()
    observed = np.zeros((width, height), np.bool_)
    for part in parts.values():
        for (x, y), flags in zip(((part.blocks - least) * size).tolist(), part.observed, strict=True):
            observed[x : x + size, y : y + size] |= flags
    origin = least * size
    ground = box.ground(origin, (width, height), lattice)
    observed &= ground
    return Window(
        **_joined(channel_count, list(parts.values())),
        observed=observed,
        observed_origin=(int(origin[0]), int(origin[1])),
        coverage=float(observed.sum() / max(1, ground.sum())),
        tiles=tuple(parts),
        missing_tiles=missing,
    )


def _joined(channel_count: int, parts: list[TilePart]) -> dict[str, NDArray]:
    """The voxel columns of all parts, one after the other; typed also when there are none."""
    if len(parts) == 1:
        return parts[0].columns
    specs = array_specs(channel_count, 0, 8)
    empty = {name: np.zeros((0, *specs[name].row_shape), specs[name].dtype) for name in LOOK_ARRAYS}
    empty |= {"points_ego": np.zeros((0, 3), np.float32), "points_world": np.zeros((0, 3))}
    return {name: np.concatenate([none, *(part.columns[name] for part in parts)]) for name, none in empty.items()}
