"""A day of many cities: real catalog code, fake stages, a clock of its own.

Drives arrive all day; every city plans once in the night, builds its stale tiles on the GPUs there are, and publishes.
Every call goes to a real catalog and is timed; reports and heartbeats are thinned, and counted in full.
"""

import heapq
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import Any

import numpy as np

from presight_core.drives import Drive
from presight_core.progress import Progress
from presight_core.recipes import Recipe
from storage.catalog import Catalog
from storage.leases import Lease
from storage.tile_states import PlannedTile

START = datetime(2026, 11, 22, tzinfo=UTC)
DAY_S = 86_400.0
HEARTBEAT_S = 15.0  # four in a lease of 60 s
REPORT_S = 0.5  # between two reports of a tile
MADE = 1  # of a tile's reports and of a city's heartbeats; it stands for all of them
TILES_A_DRIVE = 1.5  # 200 m in tiles of a square kilometre with 50 m of overlap: `bench.scale` counts 1.2 to 1.6


@dataclass(frozen=True)
class World:
    """What there is, and how long work takes."""

    cities: int = 50
    tiles: int = 200  # a city
    drives: int = 10_000  # a day, over all cities
    gpus: int = 400
    tile_s: float = 6_600.0  # 100,000 steps of 65,536 rays at a million rays a second, the target of docs/gpu.md


@dataclass
class Usage:
    """What a day asked of the catalog."""

    calls: Counter[str] = field(default_factory=Counter)  # as they would be
    made: Counter[str] = field(default_factory=Counter)  # as they were
    seconds: Counter[str] = field(default_factory=Counter)  # of those
    stale: int = 0
    waited_s: list[float] = field(default_factory=list)  # of each tile, from the plan until it has a GPU
    city_s: list[float] = field(default_factory=list)  # of each city, from the plan until it is published

    def call(self, name: str, work: Callable[[], Any], weight: int = 1) -> Any:
        """Make a call that stands for `weight` of its kind."""
        started = time.perf_counter()
        result = work()
        self.seconds[name] += time.perf_counter() - started
        self.made[name] += 1
        self.calls[name] += weight
        return result

    def busy_share(self) -> dict[str, float]:
        """Share of the day that the catalog is busy with each kind of call, one after the other."""
        return {name: count * self.seconds[name] / self.made[name] / DAY_S for name, count in self.calls.items()}


class Day:
    """The events of one day and night, until the last city is published."""

    def __init__(self, world: World, open_catalog: Callable[[Any], Catalog], seed: int = 0) -> None:
        self.world, self.usage = world, Usage()
        self.now_s = 0.0
        self.catalog = open_catalog(lambda: START + timedelta(seconds=self.now_s))
        self._random = np.random.default_rng(seed)
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._number = 0
        self._waiting: deque[tuple[str, str, float]] = deque()
        self._free_gpus = world.gpus
        self._touched: dict[str, Counter[str]] = {f"city-{city:02}": Counter() for city in range(world.cities)}
        self._open: dict[str, tuple[Lease, int, float]] = {}  # of cities at work: lease, tiles left, planned at

    def run(self) -> Usage:
        """All of it."""
        for number in range(self.world.drives):
            self._at(self._random.uniform(0, DAY_S), partial(self._ingest, number))
        for city in self._touched:
            self._at(DAY_S, partial(self._plan, city))
        while self._events:
            self.now_s, _, act = heapq.heappop(self._events)
            act()
        return self.usage

    def _at(self, when_s: float, act: Callable[[], None]) -> None:
        self._number += 1
        heapq.heappush(self._events, (when_s, self._number, act))

    def _ingest(self, number: int) -> None:
        city = f"city-{number % self.world.cities:02}"
        drive = Drive(f"{number:016x}", f"scene-{number}", city, "/data", "v", "2026-11-22", 240, number, number + 1)
        self.usage.call("ingest a drive", lambda: self.catalog.add_drive(drive))
        first = int(self._random.integers(self.world.tiles))
        for tile in range(first, first + self._random.poisson(TILES_A_DRIVE - 1) + 1):
            self._touched[city][f"t{tile % self.world.tiles:03}"] += 1

    def _plan(self, city: str) -> None:
        usage, catalog = self.usage, self.catalog
        usage.call("read the drives", lambda: catalog.drive_records(city))
        lease = usage.call("lease", lambda: catalog.leases.take(city, f"{city}:0:0:0"))
        stale = sorted(self._touched[city])
        planned = [PlannedTile(tile, "drive added", "d", 40, 9600) for tile in stale]
        usage.call("save a plan", lambda: catalog.tile_states.save_plan(city, planned, catalog.now()))
        usage.stale += len(stale)
        self._open[city] = (lease, len(stale), self.now_s)
        self._waiting.extend((city, tile, self.now_s) for tile in stale)
        self._start_tiles()

    def _start_tiles(self) -> None:
        while self._free_gpus and self._waiting:
            self._start(*self._waiting.popleft())

    def _start(self, city: str, tile: str, planned_s: float) -> None:
        self._free_gpus -= 1
        self.usage.waited_s.append(self.now_s - planned_s)
        recipe = Recipe("tile", 1, {}, {"drives": [f"{number:016x}" for number in range(40)]})
        lease = self._open[city][0]
        build = self.usage.call("start a build", lambda: self.catalog.start_build(city, tile, recipe, lease))
        length_s = self.world.tile_s * self._random.uniform(0.8, 1.2)
        weight = round(length_s / REPORT_S / MADE)
        for number in range(MADE):
            when_s = self.now_s + length_s * (number + 0.5) / MADE
            self._at(when_s, partial(self._report, build, number, weight))
        self._at(self.now_s + length_s, partial(self._finish, city, build))

    def _report(self, build: int, number: int, weight: int) -> None:
        report = Progress("training", number, MADE, {"loss": 0.1, "psnr_db": 20.0, "rays_per_s": 1e6})
        self.usage.call("report progress", lambda: self.catalog.progress(build, report), weight)

    def _finish(self, city: str, build: int) -> None:
        metrics = {"voxels": 3_000_000, "psnr_db": 23.5, "generation": 2}
        self.usage.call("end a build", lambda: self.catalog.finish_build(build, "published", metrics))
        self._free_gpus += 1
        lease, left, planned_s = self._open[city]
        self._open[city] = (lease, left - 1, planned_s)
        if left == 1:
            self._publish(city)
        self._start_tiles()

    def _publish(self, city: str) -> None:
        lease, _, planned_s = self._open.pop(city)
        span_s = self.now_s - planned_s
        weight = round(span_s / HEARTBEAT_S / MADE)
        for _ in range(MADE):
            self.usage.call("renew a lease", lambda: self.catalog.leases.renew(lease), weight)
        self.usage.call("give a lease back", lambda: self.catalog.leases.end(lease))
        self.usage.city_s.append(span_s)
