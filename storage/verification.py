"""Checks a city's store against itself: documents, history, and every build that a generation shows."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

from presight_core.errors import PresightError, StoreError
from presight_core.priors.chunks import array_document, chunk_path, decode_chunk
from presight_core.priors.documents import (
    CityDocument,
    Generation,
    GenerationTile,
    checked_name,
    city_path,
    generation_path,
    lattice_to_json,
)
from presight_core.priors.location import MOST_REQUESTS, ReadLocation
from presight_core.priors.reader import generation_numbers, read_city, read_generation, read_tag
from presight_core.priors.tile_table import StoredArray, read_group, stored_arrays
from storage.location import objects, open_store
from storage.tile_groups import contents_digest


@dataclass(frozen=True)
class Fault:
    """One thing that is not as it was written."""

    path: str  # relative to the store
    fact: str


@dataclass
class Verification:
    """What was looked at, and what is wrong."""

    generations: int = 0
    builds: int = 0
    chunks: int = 0  # read and compared; none unless deep
    faults: list[Fault] = field(default_factory=list)


def verify_city(location: str | Path, city: str, deep: bool = False) -> Verification:
    """Every fault of a city's documents and of the builds that its generations show.

    Without `deep`, chunks are counted and weighed but not read: that finds what is missing or truncated.
    With it, every byte is compared with what was written. Raises NotFoundError if the store has no such city.
    """
    return _Verifier(location, city, deep).run()


class _Verifier:
    def __init__(self, location: str | Path, city: str, deep: bool) -> None:
        self.source = ReadLocation(location)
        self.city = checked_name(city)
        self.deep = deep
        self.result = Verification()
        self.sizes = {entry.path: entry.size for entry in objects(open_store(location), self.city)}

    def run(self) -> Verification:
        try:
            facts = read_city(self.source, self.city)
        except StoreError as error:
            self._fault(city_path(self.city), str(error))
            return self.result
        generations = self._generations(facts)
        self._history(generations)
        builds = {tile.entry.path: tile for generation in generations.values() for tile in generation.tiles.values()}
        for path, tile in sorted(builds.items()):
            self.result.builds += 1
            for fault in self._build(facts, f"{self.city}/{path}", tile):
                self.result.faults.append(fault)
        return self.result

    def _generations(self, facts: CityDocument) -> dict[int, Generation]:
        """The generations that can be read; the others are faults."""
        found = {}
        for number in generation_numbers(self.source, self.city):
            self.result.generations += 1
            try:
                found[number] = read_generation(self.source, self.city, number)
            except PresightError as error:
                self._fault(generation_path(self.city, number), str(error))
                continue
            if found[number].space_id != facts.space_id:
                self._fault(generation_path(self.city, number), "is of another feature space than the city")
        return found

    def _history(self, generations: Mapping[int, Generation]) -> None:
        """Each names the bytes of its parent; below a gap only tagged ones are left, or one was lost."""
        for number, generation in generations.items():
            path, parent = generation_path(self.city, number), generation.parent
            if parent != (number - 1 or None):
                self._fault(path, f"names generation {parent} as its parent")
            content = self.source.read(generation_path(self.city, parent)) if parent else None
            if content is not None and hashlib.sha256(content).hexdigest() != generation.parent_sha256:
                self._fault(generation_path(self.city, number - 1), f"is not the one that generation {number} followed")
        tagged = self._tagged(generations)
        present = generation_numbers(self.source, self.city)
        for number, following in pairwise(present):
            if following > number + 1 and number not in tagged:
                self._fault(generation_path(self.city, number + 1), "is missing")

    def _tagged(self, generations: Mapping[int, Generation]) -> set[int]:
        numbers = set()
        for name in self.source.names(f"{self.city}/tags"):
            try:
                number = read_tag(self.source, self.city, name.removesuffix(".json"))
            except PresightError as error:
                self._fault(f"{self.city}/tags/{name}", str(error))
                continue
            numbers.add(number)
            if number not in generations:
                self._fault(f"{self.city}/tags/{name}", f"names generation {number}, which cannot be read")
        return numbers

    def _build(self, facts: CityDocument, root: str, tile: GenerationTile) -> Iterator[Fault]:
        """Faults of one build. Nothing can be said about its chunks if its own document is wrong."""
        try:
            attributes = read_group(self.source, facts, tile)
            arrays = stored_arrays(attributes, facts, tile, root)
        except (PresightError, ValueError, KeyError, TypeError) as error:
            yield Fault(f"{root}/zarr.json", str(error))
            return
        if _statement(attributes) != _expected_statement(facts, tile):
            yield Fault(f"{root}/zarr.json", "tells another tile than the generation does")
        if contents_digest(attributes["arrays"]) != tile.entry.digest:
            yield Fault(f"{root}/zarr.json", "its digests do not give the digest of the generation")
        yield from self._objects(root, tile, arrays)
        for name, array in arrays.items():
            yield from self._array_document(f"{root}/{name}/zarr.json", array)
            if self.deep:
                yield from self._chunks(f"{root}/{name}", array)

    def _objects(self, root: str, tile: GenerationTile, arrays: Mapping[str, StoredArray]) -> Iterator[Fault]:
        """Missing and unexpected objects of a build, and the sum of their sizes."""
        expected = {f"{root}/zarr.json"}
        for name, array in arrays.items():
            chunks = range(array.spec.chunk_count(array.row_count))
            expected |= {f"{root}/{name}/zarr.json"}
            expected |= {f"{root}/{name}/{chunk_path(number, array.spec)}" for number in chunks}
        present = {path: size for path, size in self.sizes.items() if path.startswith(f"{root}/")}
        yield from (Fault(path, "is missing") for path in sorted(expected - present.keys()))
        yield from (Fault(path, "does not belong here") for path in sorted(present.keys() - expected))
        if sum(present.values()) != tile.entry.bytes:
            yield Fault(root, f"holds {sum(present.values()):,} bytes, {tile.entry.bytes:,} were written")

    def _array_document(self, path: str, array: StoredArray) -> Iterator[Fault]:
        content = self.source.read(path)
        try:
            same = content is None or json.loads(content) == array_document(array.spec, array.row_count)
        except ValueError:
            same = False
        if not same:
            yield Fault(path, "does not describe the array that was written")

    def _chunks(self, root: str, array: StoredArray) -> Iterator[Fault]:
        """Faults of an array's chunks, and of all its rows together."""
        digest, whole = hashlib.sha256(), True
        every = range(array.spec.chunk_count(array.row_count))
        for numbers in (every[first : first + MOST_REQUESTS] for first in range(0, len(every), MOST_REQUESTS)):
            paths = [f"{root}/{chunk_path(number, array.spec)}" for number in numbers]
            for number, path, content in zip(numbers, paths, self.source.read_all(paths), strict=True):
                self.result.chunks += 1
                try:
                    rows = decode_chunk(content, array.spec, array.crc32c[number], path)
                except PresightError as error:
                    whole = False
                    if content is not None:  # a missing one was told before
                        yield Fault(path, str(error))
                    continue
                digest.update(rows[: array.row_count - number * array.spec.chunk_rows].data)
        if whole and digest.hexdigest() != array.sha256:
            yield Fault(root, "its rows do not give the digest that was written")

    def _fault(self, path: str, fact: str) -> None:
        self.result.faults.append(Fault(path, fact))


STATED = ("city", "lattice", "space_id", "feature_step", "drives", "voxel_count", "block_count", "digest")


def _statement(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """What a group's document says about its tile."""
    return {name: attributes.get(name) for name in STATED}


def _expected_statement(facts: CityDocument, tile: GenerationTile) -> dict[str, Any]:
    entry = tile.entry
    return {
        "city": facts.city,
        "lattice": lattice_to_json(facts.lattice),
        "space_id": facts.space_id,
        "feature_step": facts.feature_step,
        "drives": list(entry.drives),
        "voxel_count": entry.voxel_count,
        "block_count": entry.block_count,
        "digest": entry.digest,
    }
