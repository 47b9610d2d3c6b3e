"""Which generations and builds nobody needs any more, and their removal."""

from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import pairwise
from pathlib import Path

from presight_core.priors.documents import checked_name, generation_path
from presight_core.priors.location import ReadLocation
from presight_core.priors.reader import generation_numbers, read_generation, read_tag
from storage.location import StoredObject, objects, open_store, remove, remove_group

BUILD_DEPTH = 4  # <city>/tiles/<tile>/<build>: the parts of a path that name a build


@dataclass(frozen=True)
class Retention:
    """What is kept: the newest generations, every tagged one, and whatever is younger than the grace period."""

    keep: int = 20  # generations
    grace: timedelta = timedelta(days=7)  # a training run that pinned a generation, or a build at work, takes less


@dataclass(frozen=True)
class Garbage:
    """What `collect` removes."""

    generations: tuple[int, ...]
    builds: tuple[str, ...]  # paths relative to the store
    objects: tuple[StoredObject, ...]  # of the builds

    @property
    def size_bytes(self) -> int:
        """Bytes of the builds."""
        return sum(entry.size for entry in self.objects)


def find_garbage(location: str | Path, city: str, retention: Retention, now: datetime) -> Garbage:
    """What a city no longer needs. Raises StoreError if a generation or tag cannot be read: then nothing is safe."""
    return _garbage(location, checked_name(city), retention, now)


def collect(location: str | Path, city: str, retention: Retention, now: datetime) -> Garbage:
    """Remove what a city no longer needs; what it was.

    First the generations, so that nobody pins one of them any more. Then, after looking again for what was
    published meanwhile, the builds. If it breaks off, running it again does the rest.
    """
    store, first = open_store(location), find_garbage(location, city, retention, now)
    for number in first.generations:  # the oldest first, so that what is left has no gaps
        remove(store, generation_path(city, number))
    second = find_garbage(location, city, retention, now)
    for build in second.builds:
        remove_group(store, build)
    return Garbage(first.generations, second.builds, second.objects)


def _garbage(location: str | Path, city: str, retention: Retention, now: datetime) -> Garbage:
    source, oldest = ReadLocation(location), now - retention.grace
    stored = objects(open_store(location), city)
    numbers = generation_numbers(source, city)
    written = {entry.path: entry.modified for entry in stored}
    tags = [name.removesuffix(".json") for name in source.names(f"{city}/tags")]
    kept = set(numbers[-max(1, retention.keep) :]) | {read_tag(source, city, tag) for tag in tags}
    # A generation is old when the one that replaced it is.
    kept |= {number for number, following in pairwise(numbers) if written[generation_path(city, following)] > oldest}
    shown = [read_generation(source, city, number) for number in numbers if number in kept]
    needed = {f"{city}/{tile.entry.path}" for generation in shown for tile in generation.tiles.values()}
    builds: dict[str, list[StoredObject]] = {}
    for entry in stored:
        if entry.path.startswith(f"{city}/tiles/"):
            builds.setdefault("/".join(entry.path.split("/")[:BUILD_DEPTH]), []).append(entry)
    useless = {
        path: entries
        for path, entries in builds.items()
        if path not in needed and max(entry.modified for entry in entries) <= oldest
    }
    everything = tuple(entry for entries in useless.values() for entry in entries)
    return Garbage(tuple(number for number in numbers if number not in kept), tuple(sorted(useless)), everything)
