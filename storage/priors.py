"""The prior store: cities, immutable builds of tiles, and the generations that publish them."""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from obstore.store import ObjectStore

from presight_core.errors import ConflictError, InputError, NotFoundError, StoreError
from presight_core.grid import Lattice
from presight_core.priors.documents import (
    VERSION,
    CityDocument,
    Generation,
    GenerationTile,
    TileEntry,
    checked_name,
    city_path,
    decode,
    encode,
    generation_path,
    tag_path,
)
from presight_core.priors.location import ReadLocation
from presight_core.priors.reader import PriorReader, generation_numbers, read_city, read_generation, read_tag
from presight_core.priors.schema import FEATURE_STEP, VoxelBatch
from presight_core.priors.tile_table import TileTable
from storage.location import exists, open_store, put_once, remove, size_bytes
from storage.tile_groups import TileName, write_group

MOST_ATTEMPTS = 100  # each lost race means that somebody else published; so many in one call is a fault


@dataclass(frozen=True)
class PriorStore:
    """The writing side of a store. Nothing that was published is ever changed; any number of writers may race."""

    location: str | Path
    _objects: ObjectStore
    _source: ReadLocation

    @staticmethod
    def open(location: str | Path) -> "PriorStore":
        """The store in a folder (made if absent) or at a URL. Raises StoreError if it cannot be had."""
        return PriorStore(location, open_store(location), ReadLocation(location))

    def create_city(
        self, city: str, lattice: Lattice, space_id: str, channel_count: int, feature_step: int = FEATURE_STEP
    ) -> CityDocument:
        """The city's fixed facts, stored now or before. Raises ConflictError if they were stored differently.

        feature_step: 1, 3 or 5; features are kept in steps of that many 255ths.
        """
        wanted = CityDocument(city, lattice, space_id, channel_count, feature_step)
        if not put_once(self._objects, city_path(city), encode(wanted.to_json())):
            present = self.city(city)
            if present != wanted:
                raise ConflictError(
                    f"{self.location}/{city} was made with {present}, not {wanted}; "
                    "keep those settings and models, or build into another store"
                )
        return wanted

    def city(self, city: str) -> CityDocument:
        """The city's fixed facts. Raises NotFoundError if the store has no such city."""
        return read_city(self._source, city)

    def write_tile(
        self,
        city: str,
        name: TileName,
        batches: Iterable[VoxelBatch],
        drives: Sequence[str],
        attributes: Mapping[str, Any],
    ) -> TileEntry:
        """Write one build of a tile, under a name used once; see `write_group`. Only `publish` makes it seen."""
        return write_group(self._objects, self.city(city), name, batches, drives, attributes)

    def publish(
        self,
        city: str,
        tiles: Mapping[str, GenerationTile | None],
        parent: int | None,
        tiling: Mapping[str, Any] | None = None,
        fence: int | None = None,
    ) -> int:
        """Publish builds as one new generation; its number.

        `parent` is the generation that the builds were planned on (None: the city had none), and the new
        one keeps its other tiles; None for a tile takes it away. If others published meanwhile, their tiles are
        kept too. `tiling` (`Tiling.to_json`) is needed for the first generation; tiles that a new tiling has
        not, or has elsewhere, are no longer shown. `fence` is the fencing number of the publisher's lease, if it
        has one.

        Raises ConflictError if somebody else published one of the same tiles or another tiling meanwhile, or
        was given a greater fencing number,
        StoreError if a build is not whole, NotFoundError if `parent` is not there.
        """
        facts = self.city(city)
        self._check_builds(facts, tiles)
        for _ in range(MOST_ATTEMPTS):
            head = self.generation(city)
            _check_fence(city, head, fence)
            self._check_meanwhile(city, tiles, parent, head, tiling)
            generation = replace(_next(facts, head, tiles, tiling), fence=max(fence or 0, head.fence if head else 0))
            if self._commit(generation):
                return generation.number
        raise ConflictError(f"{city}: {MOST_ATTEMPTS} other generations came first; run it again")

    def raise_fence(self, city: str, fence: int) -> None:
        """Shut out every publisher with a smaller fencing number, also one that is about to put its generation.

        That takes a generation of its own, equal to the one before: it has the number that theirs would have
        had. A city that the store does not know has no such publisher. Raises ConflictError for a greater fence.
        """
        if not exists(self._objects, city_path(city)):
            return
        facts = self.city(city)
        for _ in range(MOST_ATTEMPTS):
            head = self.generation(city)
            _check_fence(city, head, fence)
            if head and head.fence == fence:
                return
            empty = {"tiling_id": "none", "city": city, "tiles": []}  # nothing is published yet
            following = _next(facts, head, {}, head.tiling if head else empty)
            if self._commit(replace(following, fence=fence)):
                return
        raise ConflictError(f"{city}: {MOST_ATTEMPTS} other generations came first; run it again")

    def fence(self, city: str) -> int:
        """The greatest fencing number that published in the city; 0 if none did."""
        head = self.generation(city)
        return head.fence if head else 0

    def _commit(self, generation: Generation) -> bool:
        """Put the generation, chained to its parent's bytes, if its number is free; False if somebody else has it."""
        path, parent = generation_path(generation.city, generation.number), generation.parent
        before = self._source.read(generation_path(generation.city, parent)) if parent else None
        parent_sha256 = None if before is None else hashlib.sha256(before).hexdigest()
        content = encode(replace(generation, parent_sha256=parent_sha256).to_json())
        # A put whose answer was lost may have landed: then what is there is our own document.
        return put_once(self._objects, path, content) or self._source.read(path) == content

    def generation(self, city: str, number: int | None = None) -> Generation | None:
        """A generation; for None the newest, or None if nothing is published. Raises NotFoundError for others."""
        if number is None and not generation_numbers(self._source, city):
            return None
        return read_generation(self._source, city, number)

    def first_showing(self, head: Generation, tile_id: str) -> int:
        """The generation that brought what `head` shows for a tile, of those that are left without a gap."""
        numbers, number = set(self.generations(head.city)), head.number
        while number - 1 in numbers:
            before = read_generation(self._source, head.city, number - 1)
            if before.tiles.get(tile_id) != head.tiles[tile_id]:
                break
            number -= 1
        return number

    def generations(self, city: str) -> list[int]:
        """Numbers of the published generations, ascending."""
        return generation_numbers(self._source, city)

    def tag(self, city: str, tag: str, number: int | None = None) -> int:
        """Name a generation, the newest if not given, for good: readers may ask for it, and nothing of it is deleted.

        Its number. Raises ConflictError if the tag stands for another one, NotFoundError without such a generation,
        InputError for a tag of digits, which would be taken for a generation's number.
        """
        if tag.isdigit():
            raise InputError(f"{city}: tag {tag} reads like a generation; use a name such as release-{tag}")
        generation = read_generation(self._source, city, number)
        self.save_document(city, "tags", tag, {"generation": generation.number})
        return generation.number

    def tags(self, city: str) -> dict[str, int]:
        """The generation of every tag."""
        names = [name.removesuffix(".json") for name in self._source.names(f"{checked_name(city)}/tags")]
        return {name: read_tag(self._source, city, name) for name in names}

    def remove_tag(self, city: str, tag: str) -> None:
        """Take a tag away; the generation stays, until it is old. Raises NotFoundError if there is no such tag."""
        read_tag(self._source, city, tag)
        remove(self._objects, tag_path(city, tag))

    def rollback(self, city: str, number: int) -> int:
        """Publish a new generation that shows exactly what an earlier one did; its number.

        Raises ConflictError if somebody published meanwhile, NotFoundError without such a generation,
        StoreError if a build of it is gone.
        """
        old, head = read_generation(self._source, city, number), read_generation(self._source, city, None)
        new = replace(old, number=head.number + 1, parent=head.number, restores=number, fence=head.fence)
        self._check_builds(self.city(city), old.tiles)
        if not self._commit(new):
            raise ConflictError(f"{city}: generation {new.number} came first; look at it, then run it again")
        return new.number

    def table(self, city: str, tile: GenerationTile) -> TileTable:
        """The table of a written build, published or not."""
        facts = self.city(city)
        tiles = {"tile": tile}
        return PriorReader(self.location, facts, Generation(0, None, city, facts.space_id, {}, tiles)).tile("tile")

    def size_bytes(self, city: str) -> int:
        """Bytes of everything the store keeps of a city: all builds and generations."""
        return size_bytes(self._objects, checked_name(city))

    def save_document(self, city: str, kind: str, name: str, value: Mapping[str, Any]) -> None:
        """Keep a JSON document as <city>/<kind>/<name>.json, such as a tiling.

        Saving the same again does nothing. Raises ConflictError if the name stands for something else.
        """
        path, content = _document_path(city, kind, name), encode({**value, "format_version": VERSION})
        if not put_once(self._objects, path, content) and self._source.read(path) != content:
            raise ConflictError(f"{self.location}/{path} is there with other content; use another name")

    def documents(self, city: str, kind: str) -> list[str]:
        """Names of the documents of a kind that `save_document` kept, sorted."""
        names = self._source.names(f"{checked_name(city)}/{checked_name(kind)}")
        return [name.removesuffix(".json") for name in names if name.endswith(".json")]

    def document(self, city: str, kind: str, name: str) -> dict[str, Any]:
        """A document that `save_document` kept. Raises NotFoundError if it is not there."""
        path = _document_path(city, kind, name)
        content = self._source.read(path)
        if content is None:
            raise NotFoundError(f"{self.location} has no {path}; save it first")
        return decode(content, f"{self.location}/{path}", _without_version)

    def _check_builds(self, facts: CityDocument, tiles: Mapping[str, GenerationTile | None]) -> None:
        for tile_id, tile in tiles.items():
            if tile is None:
                continue
            path = f"{facts.city}/{tile.entry.path}"
            if tile.entry.space_id != facts.space_id:
                raise ConflictError(
                    f"{tile_id} is in feature space {tile.entry.space_id}, {facts.city} in {facts.space_id}; "
                    "rebuild the tile with the city's models"
                )
            if not exists(self._objects, f"{path}/zarr.json"):
                raise StoreError(f"{path} is not a finished build; write the tile again")

    def _check_meanwhile(
        self,
        city: str,
        tiles: Mapping[str, GenerationTile | None],
        parent: int | None,
        head: Generation | None,
        tiling: Mapping[str, Any] | None,
    ) -> None:
        """Raise ConflictError if what was published after `parent` touches what we publish."""
        if head is None or head.number == parent:
            return
        base = read_generation(self._source, city, parent) if parent is not None else None
        before = base.tiles if base else {}
        changed = {tile_id for tile_id in head.tiles.keys() | before if head.tiles.get(tile_id) != before.get(tile_id)}
        clash = sorted(changed & tiles.keys())
        if clash:
            raise ConflictError(
                f"{city}: generation {head.number} changed {', '.join(clash)} after generation {parent}; "
                "plan and build again"
            )
        if base and tiling and base.tiling != head.tiling != tiling:
            raise ConflictError(f"{city}: generation {head.number} brought another tiling; plan and build again")


def _check_fence(city: str, head: Generation | None, fence: int | None) -> None:
    if head and fence is not None and head.fence > fence:
        raise ConflictError(
            f"{city}: generation {head.number} has fencing number {head.fence}, this run {fence}: it was taken for "
            "dead and may no longer publish; run `presight build` again"
        )


def _next(
    facts: CityDocument,
    head: Generation | None,
    tiles: Mapping[str, GenerationTile | None],
    tiling: Mapping[str, Any] | None,
) -> Generation:
    """The generation after `head`: its tiles where the tiling still has them, and the new ones; None takes one away."""
    chosen = dict(tiling) if tiling else head.tiling if head else None
    if chosen is None:
        raise InputError(f"{facts.city}: the first generation needs the city's tiling; pass tiling=")
    places = _places(chosen)
    unknown = sorted({tile_id for tile_id, tile in tiles.items() if tile} - places.keys())
    if unknown:
        raise InputError(f"{facts.city}: {', '.join(unknown)} not in tiling {chosen['tiling_id']}; plan again")
    kept: dict[str, GenerationTile] = {}
    if head is not None:
        old = _places(head.tiling)
        kept = {tile_id: tile for tile_id, tile in head.tiles.items() if places.get(tile_id) == old[tile_id]}
    number, parent = (head.number + 1, head.number) if head else (1, None)
    shown = {tile_id: tile for tile_id, tile in {**kept, **tiles}.items() if tile is not None}
    return Generation(number, parent, facts.city, facts.space_id, chosen, shown)


def _places(tiling: Mapping[str, Any]) -> dict[str, Any]:
    return {tile["tile_id"]: tile["centroid_m"] for tile in tiling["tiles"]}


def _without_version(value: Mapping[str, Any]) -> dict[str, Any]:
    return {name: item for name, item in value.items() if name != "format_version"}


def _document_path(city: str, kind: str, name: str) -> str:
    return f"{checked_name(city)}/{checked_name(kind)}/{checked_name(name)}.json"
