"""Row R7 of docs/reliability.md: writers, readers and a run that was taken for dead, all in processes of their own."""

from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from uuid import uuid4

import numpy as np
import pytest

from flows import reconcile
from presight_core.priors.documents import GenerationTile
from presight_core.priors.example import ExampleTile
from presight_core.priors.reader import CollectedError, PriorReader
from storage.priors import PriorStore
from storage.retention import Retention, collect
from storage.tile_groups import TileName
from tests.torture import children
from tests.torture.conftest import whole_run
from tests.torture.toy_city import CITY, ToyCity

pytestmark = pytest.mark.slow

WRITERS = 8
TILING = {
    "tiling_id": "tiling-1",
    "city": CITY,
    "tiles": [{"tile_id": f"t{number:03}", "centroid_m": [100.0 * number, 0.0]} for number in range(WRITERS)],
}
EXAMPLE = ExampleTile(side_blocks=2)


def make_city(location: str) -> None:
    """A city with an empty first generation."""
    store = PriorStore.open(location)
    store.create_city(CITY, EXAMPLE.lattice, "space-1", EXAMPLE.channel_count)
    store.publish(CITY, {}, None, TILING)


def publish_often(location: str, tile_id: str, count: int, acknowledge) -> None:
    """Publish so many builds of one tile, each planned on what is newest, and say each generation's number."""
    store = PriorStore.open(location)
    entry = store.write_tile(CITY, TileName(tile_id, "build-1"), EXAMPLE.batches(), ["a", "b", "c"], {})
    for number in range(count):
        tile = GenerationTile(entry, {"tile": tile_id, "count": number})
        head = store.generation(CITY)
        assert head is not None
        acknowledge(store.publish(CITY, {tile_id: tile}, head.number))


def read_until(location: str, count: int) -> None:
    """Open the newest generation again and again until there are so many; each must be whole, and none older."""
    newest = 0
    while newest < count:
        reader = PriorReader.open(location, CITY)
        assert reader.generation.number >= newest
        newest = reader.generation.number
        for tile_id in reader.tiles:
            assert reader.tile(tile_id).all_rows("hits").sum() > 0


def history(location: str) -> list:
    """All generations: number, parent, and how often each tile was published so far."""
    store, told = PriorStore.open(location), []
    for number in store.generations(CITY):
        generation = store.generation(CITY, number)
        assert generation is not None
        counts = {tile_id: tile.recipe["count"] for tile_id, tile in generation.tiles.items()}
        told.append([number, generation.parent, counts])
    return told


def in_parallel(location: str, commits: int, log: Path) -> None:
    """Eight writers of a tile each and a reader: AssertionError unless the history is linear and complete."""
    children.result(lambda: make_city(location), log)
    each = -(-commits // WRITERS)
    total = 1 + WRITERS * each
    writers = [
        children.start(lambda say, tile=f"t{number:03}": publish_often(location, tile, each, say), log)
        for number in range(WRITERS)
    ]
    reader = children.start(lambda _: read_until(location, total), log)
    outcomes = [writer.wait() for writer in writers]
    assert [code for code, _ in [*outcomes, reader.wait()]] == [0] * (WRITERS + 1), log.read_text()
    acknowledged = sorted(number for _, said in outcomes for number in said)
    assert acknowledged == list(range(2, total + 1)), "every acknowledged commit has a generation of its own"
    told = children.result(lambda: history(location), log)
    assert [(number, parent) for number, parent, _ in told] == [(n, n - 1 or None) for n in range(1, total + 1)]
    for (_, _, before), (_, _, after) in pairwise(told):
        assert sum(after.values()) + len(after) == sum(before.values()) + len(before) + 1, "one commit, one change"
    assert told[-1][2] == {f"t{number:03}": each - 1 for number in range(WRITERS)}


def silent_build(city: ToyCity):
    """A build without heartbeat: one that is stopped while it beats would keep SQLite's lock as it sleeps."""

    def work(acknowledge) -> None:
        reconcile.BEATS = 1e-6
        acknowledge(city.build())

    return work


def test_eight_writers_of_a_folder_lose_nothing(tmp_path, is_long):
    in_parallel(str(tmp_path / "store"), 5000 if is_long else 104, tmp_path / "log")


def test_eight_writers_of_an_s3_store_lose_nothing(s3, tmp_path, is_long):
    in_parallel(s3, 1000 if is_long else 104, tmp_path / "log")


def read_pinned(location: str, acknowledge) -> None:
    """Read windows of the newest generation until it is collected; each is what was written, bit for bit."""
    reader = PriorReader.open(location, CITY, cache_bytes=0)  # nothing is kept: every window reads the disk
    truth = window_of(reader)
    acknowledge("pinned")
    count = 0
    while True:
        try:
            found = window_of(reader)
        except CollectedError as error:
            acknowledge([count, str(error)])
            return
        assert all(np.array_equal(first, second) for first, second in zip(found, truth, strict=True))
        count += 1


def window_of(reader: PriorReader) -> list:
    window = reader.window(np.eye(4), (-60, 60), (-60, 60), (-90, 90))
    assert len(window) > 0
    return [window.points_world, window.features, window.hits, window.observed]


def replace_and_collect(location: str, grace: timedelta, acknowledge) -> None:
    """Publish another build in the place of what is shown, and collect."""
    store = PriorStore.open(location)
    entry = store.write_tile(CITY, TileName("t000", uuid4().hex), EXAMPLE.batches(), ["a", "b", "c"], {})
    number = store.publish(CITY, {"t000": GenerationTile(entry, {"build": entry.path})}, store.generations(CITY)[-1])
    garbage = collect(location, CITY, Retention(keep=1, grace=grace), datetime.now(UTC))
    acknowledge([number, len(garbage.generations), len(garbage.builds)])


@pytest.mark.parametrize("place", ["folder", "s3"])
def test_what_is_collected_while_it_is_read_is_true_or_said_to_be_gone(place, tmp_path, request):
    location = str(tmp_path / "store") if place == "folder" else request.getfixturevalue("s3")
    log, none = tmp_path / "log", timedelta(0)
    children.result(lambda: make_city(location), log)
    assert children.run(lambda say: replace_and_collect(location, none, say), log)[0] == 0
    readers = [children.start(lambda say: read_pinned(location, say), log) for _ in range(4)]
    for reader in readers:
        reader.until_said()
    (collected,) = children.run(lambda say: replace_and_collect(location, none, say), log)[1]
    assert collected == [3, 1, 1], log.read_text()
    for code, said in [reader.wait() for reader in readers]:
        assert code == 0, log.read_text()
        assert "generation 2 was removed while it was read" in said[-1][1]


def test_nobody_is_disturbed_within_the_grace_period(tmp_path):
    location, week = str(tmp_path / "store"), timedelta(days=7)

    def work(acknowledge) -> None:
        make_city(location)
        replace_and_collect(location, week, acknowledge)
        reader = PriorReader.open(location, CITY, cache_bytes=0)
        truth = window_of(reader)
        replace_and_collect(location, week, acknowledge)
        assert all(np.array_equal(*pair) for pair in zip(window_of(reader), truth, strict=True))

    assert children.run(work, tmp_path / "log") == (0, [[2, 0, 0], [3, 0, 0]]), (tmp_path / "log").read_text()


def test_eight_runs_of_one_city_build_it_once(city, truth):
    log = city.root / "log"
    children.result(city.ingest, log)
    runs = [children.start(lambda say: say(city.build(wait=True)), log) for _ in range(8)]
    outcomes = [run.wait() for run in runs]
    assert outcomes == [(0, [1])] * 8, log.read_text()
    assert children.result(city.check, log) == truth
    assert len(list((city.root / "store" / CITY / "tiles").glob("*/*"))) == 2, "each tile was written once"


def test_a_second_run_that_shall_not_wait_is_refused(city):
    log = city.root / "log"
    children.result(city.ingest, log)
    first = children.start(lambda say: say(city.build()), log, "lease-taken:stop")
    first.until_stopped()
    code, said = children.run(lambda say: say(city.build()), log)
    assert (code, said) == (5, [])
    first.signal(18)  # SIGCONT
    assert first.wait() == (0, [1])


@pytest.mark.parametrize("name", ["publish-before", "store-before-put@5", "store-before-put@3"])
def test_a_run_that_sleeps_longer_than_its_lease_publishes_nothing_when_it_wakes(name, city, truth):
    """The fifth put is its generation: it has looked at everything, and would put at once. The third is a group."""
    log = city.root / "log"
    (city.root / "presight.toml").write_text("lease_s = 1.0\n")
    children.result(city.ingest, log)
    point, _, meeting = name.partition("@")
    sleeper = children.start(silent_build(city), log, f"{point}:stop@{meeting or 1}")
    sleeper.until_stopped()
    (number,) = children.run(lambda say: say(city.build(wait=True)), log)[1]
    shown = children.result(city.check, log)
    assert shown == truth
    sleeper.signal(18)  # SIGCONT
    code, said = sleeper.wait()
    assert (code, said) == (5, []), log.read_text()
    assert children.result(city.check, log) == shown
    assert children.result(lambda: city.workspace.store().generations(CITY)[-1], log) == number
    assert children.result(whole_run(city), log) == truth


def test_a_run_that_wakes_before_it_planned_finds_nothing_to_do(city):
    log = city.root / "log"
    (city.root / "presight.toml").write_text("lease_s = 1.0\n")
    children.result(city.ingest, log)
    sleeper = children.start(silent_build(city), log, "lease-taken:stop")
    sleeper.until_stopped()
    code, said = children.run(lambda say: say(city.build(wait=True)), log)
    assert code == 0, log.read_text()
    sleeper.signal(18)  # SIGCONT
    assert sleeper.wait() == (0, said)


def test_the_sleeper_is_shut_out_of_an_s3_store(s3, city, truth):
    (city.root / "presight.toml").write_text(f'lease_s = 1.0\nstore = "{s3}"\n')
    log = city.root / "log"
    children.result(city.ingest, log)
    sleeper = children.start(silent_build(city), log, "publish-before:stop")
    sleeper.until_stopped()
    assert children.run(lambda say: say(city.build(wait=True)), log)[0] == 0
    sleeper.signal(18)
    assert sleeper.wait() == (5, []), log.read_text()
    assert children.result(lambda: city.workspace.store().generations(CITY), log) == [1, 2]
