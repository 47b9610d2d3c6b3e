"""Garbage collection: what nobody needs goes, and nothing else."""

import shutil
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from presight_core.errors import InputError, NotFoundError, StoreError
from presight_core.priors import CollectedError, PriorReader
from storage.retention import Retention, collect, find_garbage
from storage.verification import verify_city

LATER = timedelta(days=30)
KEEP_ONE = Retention(keep=1)


def later() -> datetime:
    """A month after everything was written."""
    return datetime.now(UTC) + LATER


@pytest.fixture
def rebuilt(town):
    """Generations 1, 2 and 3 show builds 1, 2 and 3 of one tile."""
    for number in (2, 3):
        town.store.publish("town", {"t000": town.write("t000", f"build-{number}")}, number - 1)
    return town


def builds(town) -> list[str]:
    return sorted(file.parent.name for file in town.location.glob("town/tiles/*/*/zarr.json"))


def test_only_what_the_newest_generation_shows_is_left(rebuilt):
    garbage = collect(rebuilt.location, "town", KEEP_ONE, later())
    assert garbage.generations == (1, 2)
    assert garbage.builds == ("town/tiles/t000/build-1", "town/tiles/t000/build-2")
    assert garbage.size_bytes > 1000
    assert builds(rebuilt) == ["build-3"]
    assert rebuilt.store.generations("town") == [3]
    assert len(rebuilt.reader().window(np.eye(4))) > 0
    assert verify_city(rebuilt.location, "town", deep=True).faults == []


def test_a_tag_keeps_its_generation_and_builds(rebuilt):
    rebuilt.store.tag("town", "release", 1)
    collect(rebuilt.location, "town", KEEP_ONE, later())
    assert builds(rebuilt) == ["build-1", "build-3"]
    assert len(PriorReader.open(rebuilt.location, "town", "release").window(np.eye(4))) > 0
    assert verify_city(rebuilt.location, "town", deep=True).faults == []


def test_nothing_goes_within_the_grace_period(rebuilt):
    garbage = collect(rebuilt.location, "town", KEEP_ONE, datetime.now(UTC) + timedelta(days=6))
    assert (garbage.generations, garbage.builds) == ((), ())
    assert builds(rebuilt) == ["build-1", "build-2", "build-3"]


def test_a_rolled_back_build_is_needed(rebuilt):
    rebuilt.store.rollback("town", 1)
    collect(rebuilt.location, "town", KEEP_ONE, later())
    assert builds(rebuilt) == ["build-1"]


def test_unfinished_builds_go_when_they_are_old(rebuilt):
    (rebuilt.location / "town/tiles/t000/build-3").joinpath("zarr.json").rename(rebuilt.location / "kept")
    stray = rebuilt.location / "town/tiles/t001/broken-off/hits/c/0"
    stray.parent.mkdir(parents=True)
    stray.write_bytes(b"half")
    (rebuilt.location / "kept").rename(rebuilt.location / "town/tiles/t000/build-3/zarr.json")
    assert find_garbage(rebuilt.location, "town", KEEP_ONE, datetime.now(UTC)).builds == ()
    collect(rebuilt.location, "town", KEEP_ONE, later())
    assert not stray.exists()


def test_looking_for_garbage_removes_nothing(rebuilt):
    found = find_garbage(rebuilt.location, "town", KEEP_ONE, later())
    assert found.generations == (1, 2)
    assert builds(rebuilt) == ["build-1", "build-2", "build-3"]


def test_a_reader_of_what_was_collected_is_told_so(rebuilt):
    pinned = rebuilt.reader(1)
    collect(rebuilt.location, "town", KEEP_ONE, later())
    with pytest.raises(CollectedError, match="generation 1 was removed while it was read; open the newest one"):
        pinned.window(np.eye(4))


def test_what_is_lost_without_a_collection_is_damage(rebuilt):
    shutil.rmtree(rebuilt.location / "town/tiles/t000/build-3")
    with pytest.raises(StoreError, match="missing, though a generation shows it"):
        rebuilt.reader(3).window(np.eye(4))


def test_no_folder_stays_of_what_was_collected(rebuilt):
    collect(rebuilt.location, "town", KEEP_ONE, later())
    assert [folder.name for folder in (rebuilt.location / "town/tiles/t000").iterdir()] == ["build-3"]


def test_an_unfinished_document_is_no_tag_and_no_generation(rebuilt):
    for place in ("tags/draft.json#1", "generations/00000004.json#7"):
        (rebuilt.location / "town" / place).parent.mkdir(exist_ok=True)
        (rebuilt.location / "town" / place).write_bytes(b"ha")
    assert rebuilt.store.tags("town") == {}
    assert rebuilt.store.generations("town") == [1, 2, 3]
    assert verify_city(rebuilt.location, "town").faults == []
    assert collect(rebuilt.location, "town", KEEP_ONE, later()).generations == (1, 2)


def test_a_damaged_history_stops_it(rebuilt):
    (rebuilt.location / "town/generations/00000003.json").write_bytes(b"{")
    with pytest.raises(StoreError):
        collect(rebuilt.location, "town", KEEP_ONE, later())
    assert builds(rebuilt) == ["build-1", "build-2", "build-3"]


def test_a_rollback_shows_what_the_earlier_generation_did(rebuilt):
    assert rebuilt.store.rollback("town", 1) == 4
    first, fourth = (rebuilt.store.generation("town", number) for number in (1, 4))
    assert fourth.tiles == first.tiles
    assert fourth.tiling == first.tiling
    assert (fourth.parent, fourth.restores) == (3, 1)
    assert verify_city(rebuilt.location, "town").faults == []


def test_a_rollback_to_a_collected_build_is_refused(rebuilt):
    rebuilt.store.tag("town", "release", 1)
    (rebuilt.location / "town/tiles/t000/build-1/zarr.json").unlink()
    with pytest.raises(StoreError, match="not a finished build"):
        rebuilt.store.rollback("town", 1)
    assert rebuilt.store.generations("town") == [1, 2, 3]


def test_tags_are_listed_set_once_and_taken_away(rebuilt):
    assert rebuilt.store.tag("town", "release") == 3
    rebuilt.store.tag("town", "release", 3)
    assert rebuilt.store.tags("town") == {"release": 3}
    with pytest.raises(Exception, match="other content"):
        rebuilt.store.tag("town", "release", 2)
    with pytest.raises(InputError, match="reads like a generation"):
        rebuilt.store.tag("town", "7")
    rebuilt.store.remove_tag("town", "release")
    assert rebuilt.store.tags("town") == {}
    with pytest.raises(NotFoundError):
        rebuilt.store.remove_tag("town", "release")
