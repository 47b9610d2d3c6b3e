"""Row R1 of docs/reliability.md: whatever two writers, a cleaner and readers do to a store, it equals a dict."""

import atexit
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from obstore.store import ObjectStore

import storage.priors
from presight_core.errors import ConflictError, NotFoundError, StoreError
from presight_core.priors import CollectedError, PriorReader
from presight_core.priors.documents import Generation, GenerationTile, TileEntry
from presight_core.priors.example import ExampleTile
from storage.location import put_once
from storage.priors import PriorStore
from storage.retention import Retention, collect
from storage.tile_groups import TileName
from tests.torture.conftest import LONG

CITY = "town"
TILES = ("t000", "t001", "t002")
TAGS = ("release", "paper")
TILING = {
    "tiling_id": "tiling-1",
    "city": CITY,
    "tiles": [{"tile_id": tile, "centroid_m": [100.0 * place, 0.0]} for place, tile in enumerate(TILES)],
}
EXAMPLE = ExampleTile(side_blocks=2, voxels_per_block=5, channel_count=2)
EVERYWHERE = ((-60, 60), (-60, 60), (-90, 90))
EXAMPLES, STEPS = (1000, 500) if os.environ.get(LONG) else (200, 50)
SEEDS = 5
MEMORY = Path("/dev/shm")
PLACE = MEMORY if MEMORY.is_dir() else None  # where it costs nothing to force a file to the disk

Model = dict[str, str]  # by tile, the path of the build that is shown


@dataclass(frozen=True)
class Template:
    """A build that was written once."""

    folder: Path
    entry: TileEntry
    hits: int


@cache
def templates() -> list[Template]:
    """Builds of different content, in a store that goes with the process."""
    folder = Path(tempfile.mkdtemp(prefix="presight-model-", dir=PLACE))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    store = PriorStore.open(folder)
    store.create_city(CITY, EXAMPLE.lattice, "space-1", EXAMPLE.channel_count)
    made = []
    for seed in range(SEEDS):
        batches = list(replace(EXAMPLE, seed=seed).batches())
        entry = store.write_tile(CITY, TileName("t000", f"build-{seed}"), batches, ["a", "b", "c"], {})
        made.append(Template(folder / CITY / entry.path, entry, sum(int(batch.hits.sum()) for batch in batches)))
    return made


class StoreEqualsModel(RuleBasedStateMachine):
    """The model: for every generation that is there its tiles; the fence; the tags; the builds that are there."""

    @initialize()
    def make(self) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="presight-model-", dir=PLACE))
        self.store = PriorStore.open(self.folder)
        self.store.create_city(CITY, EXAMPLE.lattice, "space-1", EXAMPLE.channel_count)
        self.newest = self.store.publish(CITY, {}, None, TILING)
        self.model: dict[int, Model] = {1: {}}
        self.entries: dict[str, GenerationTile] = {}
        self.tags: dict[str, int] = {}
        self.readers: list[PriorReader] = []
        self.hits: dict[str, int] = {}  # of every build that ever was: tells which one is read
        self.collected: list[GenerationTile] = []
        self.fence, self.written = 0, 0

    def teardown(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)

    @rule(tile=st.sampled_from(TILES), behind=st.integers(0, 3), lag=st.integers(-1, 2), fenced=st.booleans())
    def publish(self, tile: str, behind: int, lag: int, fenced: bool) -> None:
        """Publish a build that was planned some generations ago, with or without a fencing number."""
        parent, fence = self.back(behind), max(0, self.fence - lag) if fenced else None
        new = self.build(tile)
        if self.changed(tile, parent) or (fence is not None and fence < self.fence):
            with pytest.raises(ConflictError):
                self.store.publish(CITY, {tile: new}, parent, fence=fence)
            return
        self.shows(self.store.publish(CITY, {tile: new}, parent, fence=fence), {**self.head, tile: new.entry.path})
        self.fence = max(self.fence, fence or 0)

    @rule(mine=st.sampled_from(TILES), theirs=st.sampled_from(TILES))
    def publish_while_another_does(self, mine: str, theirs: str) -> None:
        """Another writer puts its generation after this one looked and before it puts its own."""
        parent, new, other = self.newest, self.build(mine), self.build(theirs)

        def race() -> None:
            number = PriorStore.open(self.folder).publish(CITY, {theirs: other}, parent)
            self.shows(number, {**self.head, theirs: other.entry.path})

        with before_the_put(race):
            if mine == theirs:
                with pytest.raises(ConflictError):
                    self.store.publish(CITY, {mine: new}, parent)
            else:
                self.shows(self.store.publish(CITY, {mine: new}, parent), {**self.head, mine: new.entry.path})

    @rule(tile=st.sampled_from(TILES))
    def withdraw(self, tile: str) -> None:
        number = self.store.publish(CITY, {tile: None}, self.newest)
        self.shows(number, {name: path for name, path in self.head.items() if name != tile})

    @rule(step=st.integers(-1, 2))
    def raise_fence(self, step: int) -> None:
        fence = max(0, self.fence + step)
        if fence < self.fence:
            with pytest.raises(ConflictError):
                self.store.raise_fence(CITY, fence)
            return
        self.store.raise_fence(CITY, fence)
        if fence > self.fence:
            self.shows(self.newest + 1, self.head)
            self.fence = fence

    @rule(back=st.integers(0, 5))
    def roll_back(self, back: int) -> None:
        number = self.back(back)
        self.shows(self.store.rollback(CITY, number), self.model[number])

    @rule(back=st.integers(0, 5))
    def roll_back_while_another_publishes(self, back: int) -> None:
        number = self.back(back)
        with before_the_put(lambda: self.publish("t000", 0, 0, fenced=False)), pytest.raises(ConflictError):
            self.store.rollback(CITY, number)

    @rule(name=st.sampled_from(TAGS), back=st.integers(0, 5))
    def tag(self, name: str, back: int) -> None:
        number = self.back(back)
        if self.tags.setdefault(name, number) != number:
            with pytest.raises(ConflictError):
                self.store.tag(CITY, name, number)
            return
        assert self.store.tag(CITY, name, number) == number

    @rule(name=st.sampled_from(TAGS))
    def remove_tag(self, name: str) -> None:
        if self.tags.pop(name, None) is None:
            with pytest.raises(NotFoundError):
                self.store.remove_tag(CITY, name)
            return
        self.store.remove_tag(CITY, name)

    @rule(keep=st.integers(1, 4))
    def collect(self, keep: int) -> None:
        """Generations go that are neither new nor tagged, and the builds that none of the others shows."""
        kept = {*sorted(self.model)[-keep:], *self.tags.values()}
        gone = collect(self.folder, CITY, Retention(keep, timedelta(0)), a_month_later())
        assert list(gone.generations) == sorted(self.model.keys() - kept)
        self.model = {number: shown for number, shown in self.model.items() if number in kept}
        needed = {path for shown in self.model.values() for path in shown.values()}
        assert set(gone.builds) == {f"{CITY}/{path}" for path in self.entries.keys() - needed}
        self.collected = [entry for path, entry in self.entries.items() if path not in needed]
        self.entries = {path: entry for path, entry in self.entries.items() if path in needed}

    @rule(keep=st.integers(1, 4))
    def collect_within_the_grace_period(self, keep: int) -> None:
        gone = collect(self.folder, CITY, Retention(keep), datetime.now(UTC))
        assert (gone.generations, gone.builds) == ((), ())

    @precondition(lambda self: getattr(self, "collected", None))
    @rule()
    def publish_what_was_collected(self) -> None:
        new = self.collected[0]
        with pytest.raises(StoreError, match="not a finished build"):
            self.store.publish(CITY, {new.entry.path.split("/")[1]: new}, self.newest)

    @rule()
    def open_again(self) -> None:
        self.store = PriorStore.open(self.folder)

    @rule(back=st.integers(0, 5))
    def pin(self, back: int) -> None:
        """A reader sees exactly the generation that it opened."""
        number = self.back(back)
        self.readers = [*self.readers[-2:], PriorReader.open(self.folder, CITY, number)]
        assert seen(self.readers[-1].generation) == self.model[number]

    @rule(number=st.integers(1, 50))
    def pin_by_number(self, number: int) -> None:
        if number not in self.model:
            with pytest.raises(NotFoundError):
                PriorReader.open(self.folder, CITY, number)
            return
        assert seen(PriorReader.open(self.folder, CITY, number).generation) == self.model[number]

    @rule(name=st.sampled_from(TAGS))
    def pin_by_tag(self, name: str) -> None:
        if name not in self.tags:
            with pytest.raises(NotFoundError):
                PriorReader.open(self.folder, CITY, name)
            return
        assert PriorReader.open(self.folder, CITY, name).generation.number == self.tags[name]

    @precondition(lambda self: getattr(self, "readers", None))
    @rule(which=st.integers(0, 2), fresh=st.booleans())
    def read(self, which: int, fresh: bool) -> None:
        """A pinned reader gives what its generation showed, or says that the generation was collected."""
        reader = self.readers[which % len(self.readers)]
        if fresh:  # as a worker of a data loader has it: nothing that was read before helps it
            reader = copy(reader)
        try:
            window = reader.window(np.eye(4), *EVERYWHERE)
        except CollectedError:
            assert reader.generation.number not in self.model
            return
        truth = sum(self.hits[path] for path in seen(reader.generation).values())
        assert (window.hits.sum(), window.tiles) == (truth, reader.tiles)

    @invariant()
    def the_newest_is_the_model(self) -> None:
        if hasattr(self, "model"):
            head = self.store.generation(CITY)
            assert head is not None
            assert (head.number, seen(head), head.fence) == (self.newest, self.head, self.fence)
            assert self.store.generations(CITY) == sorted(self.model)

    @property
    def head(self) -> Model:
        """What the newest generation shows."""
        return self.model[self.newest]

    def back(self, steps: int) -> int:
        """The number of a generation that is there, so many before the newest."""
        numbers = sorted(self.model)
        return numbers[max(0, len(numbers) - 1 - steps)]

    def changed(self, tile: str, parent: int) -> bool:
        return self.head.get(tile) != self.model[parent].get(tile)

    def build(self, tile: str) -> GenerationTile:
        """Another build of a tile: a copy, as writing is not what is tested here."""
        self.written += 1
        seed, template = self.written % SEEDS, templates()
        entry = replace(template[seed].entry, path=f"tiles/{tile}/build-{self.written}")
        shutil.copytree(template[seed].folder, self.folder / CITY / entry.path, copy_function=os.link)
        self.entries[entry.path] = GenerationTile(entry, {"build": self.written})
        self.hits[entry.path] = template[seed].hits
        return self.entries[entry.path]

    def shows(self, number: int, shown: Model) -> None:
        """What a call said that it published."""
        assert number == self.newest + 1
        self.newest = number
        self.model[number] = shown


def seen(generation: Generation) -> Model:
    return {tile: shown.entry.path for tile, shown in generation.tiles.items()}


def a_month_later() -> datetime:
    """When everything is old."""
    return datetime.now(UTC) + timedelta(days=30)


@contextmanager
def before_the_put(race: Callable[[], None]) -> Iterator[None]:
    """Let something happen between a writer's last look and its first put of a generation."""
    waiting = [race]

    def put(objects: ObjectStore, path: str, content: bytes) -> bool:
        if waiting and "/generations/" in path:
            waiting.pop()()
        return put_once(objects, path, content)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(storage.priors, "put_once", put)
        yield


StoreEqualsModel.TestCase.settings = settings(
    max_examples=EXAMPLES, stateful_step_count=STEPS, deadline=None, suppress_health_check=list(HealthCheck)
)
TestStore = pytest.mark.slow(StoreEqualsModel.TestCase)
