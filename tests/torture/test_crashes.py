"""Rows R2, R3 and R15 of docs/reliability.md: kill -9 at every named point, and at any moment."""

import random
import re
import time
from datetime import timedelta
from pathlib import Path

import pytest

from flows.publication import roll_back
from flows.store_care import clean
from presight_core import failpoints
from storage.retention import Retention
from storage.verification import verify_city
from tests.torture import children
from tests.torture.conftest import copy_of, whole_run
from tests.torture.toy_city import CITY, ToyCity

pytestmark = pytest.mark.slow

KEEP_ONE = Retention(keep=1, grace=timedelta(0))
COUNT_ALL = f"{failpoints.NAMES[0]}:raise@999999"  # arms nothing that is ever met so often


def everything(city: ToyCity):
    """The whole pipeline, saying what is done once it is."""

    def work(acknowledge) -> None:
        city.ingest()
        acknowledge("ingested")
        acknowledge({"generation": city.build()})

    return work


def survives(city: ToyCity, said: list, truth: dict[str, str], log: Path) -> None:
    """Old or new, whole; nothing that was acknowledged is lost; running again ends in the same tiles."""
    shown = children.result(city.check, log)
    assert shown in ({}, truth)
    if any("generation" in each for each in said):
        assert shown == truth
    if "ingested" in said:
        assert children.result(lambda: len(city.workspace.catalog().drives()), log) == 2
    assert children.result(whole_run(city), log) == truth


def counted(city: ToyCity, work) -> dict[str, int]:
    """How often some work on a city meets every failpoint."""

    def counting(acknowledge) -> None:
        work(city)(lambda _: None)
        acknowledge(dict(failpoints._met))

    code, said = children.run(counting, city.root / "log", COUNT_ALL)
    assert code == 0, (city.root / "log").read_text()
    return said[-1]


def chosen(meetings: int, is_long: bool) -> list[int]:
    """Which meetings of a failpoint to die at: all, or the first, the middle and the last."""
    return list(range(1, meetings + 1)) if is_long else sorted({1, (meetings + 1) // 2, meetings})


@pytest.fixture(scope="module")
def meetings(prepared, tmp_path_factory) -> dict[str, int]:
    """How often the pipeline meets every failpoint."""
    return counted(copy_of(prepared, tmp_path_factory.mktemp("counted")), everything)


def test_every_failpoint_is_somewhere_in_the_code():
    root = Path(__file__).resolve().parents[2]
    sources = [file for part in ("flows", "stages", "storage", "presight_core") for file in (root / part).rglob("*.py")]
    found = {name for file in sources for name in re.findall(r'failpoint\("([a-z-]+)"\)', file.read_text())}
    assert found == set(failpoints.NAMES)


IN_CARE = ("store-before-put", "store-after-put", "file-before-link", "catalog-before-commit", "lease-ended")
IN_CARE_ONLY = ("store-before-delete", "store-after-delete", "group-half-deleted")
IN_FOLDERS = ("folder-before-rename", "folder-after-rename")  # of artifacts and checkpoints


@pytest.mark.parametrize("name", sorted({*failpoints.NAMES} - {*IN_CARE_ONLY, *IN_FOLDERS}))
def test_a_kill_at_a_named_point_leaves_old_or_new_and_the_next_run_completes(
    name, city, prepared, truth, meetings, is_long
):
    for number in chosen(meetings[name], is_long):
        city = copy_of(prepared, city.root.parent)
        log = city.root.parent / "log"
        code, said = children.run(everything(city), log, f"{name}:kill@{number}")
        assert code == children.KILLED, f"{name}@{number} was not met; {log.read_text()}"
        survives(city, said, truth, log)


def care(city: ToyCity):
    """Name a generation, show it again, and remove what is old, saying what is done once it is."""

    def work(acknowledge) -> None:
        city.workspace.store().tag(CITY, "release", 2)
        acknowledge("tagged")
        roll_back(city.root, CITY, 1)
        acknowledge("rolled back")
        city.workspace.store().remove_tag(CITY, "draft")
        acknowledge("tag removed")
        clean(city.root, CITY, KEEP_ONE, dry_run=False, as_json=False)
        acknowledge("cleaned")

    return work


def cared_for(city: ToyCity, said: list, truth: dict[str, str]) -> None:
    """Nothing that was acknowledged is lost, what is shown is whole and true, and gc can be run again."""
    store = city.workspace.store()
    assert city.check(allow_gaps=True) == truth
    assert verify_city(store.location, CITY, deep=True).faults == []
    numbers, head, tags = store.generations(CITY), store.generation(CITY), store.tags(CITY)
    assert head is not None
    assert "tagged" not in said or tags["release"] == 2
    assert "rolled back" not in said or head.restores == 1
    assert "tag removed" not in said or "draft" not in tags
    assert "cleaned" not in said or numbers == [2, 4]
    clean(city.root, CITY, KEEP_ONE, dry_run=False, as_json=False)  # which may bring a generation with a new fence
    kept = [store.generation(CITY, number) for number in store.generations(CITY)]
    shown = {tile.entry.path for each in kept if each for tile in each.tiles.values()}
    groups = {str(folder.relative_to(city.root / "store" / CITY)) for folder in city.groups()}
    assert [each.number for each in kept if each] == sorted({*tags.values(), store.generations(CITY)[-1]})
    assert groups == shown
    assert city.check(allow_gaps=True) == truth


@pytest.fixture(scope="module")
def old_city(prepared, tmp_path_factory) -> ToyCity:
    """A toy city with three generations and a tag."""
    city = copy_of(prepared, tmp_path_factory.mktemp("old"))

    def work() -> None:
        city.ingest()
        for steps in (70, 71, 72):
            city.build(overrides=(f"training.steps={steps}",))
        city.workspace.store().tag(CITY, "draft", 3)

    children.result(work, city.root / "log")
    return city


@pytest.fixture(scope="module")
def care_meetings(old_city, tmp_path_factory) -> dict[str, int]:
    """How often looking after a city meets every failpoint."""
    return counted(copy_of(old_city, tmp_path_factory.mktemp("counted")), care)


@pytest.mark.parametrize("name", [*IN_CARE, *IN_CARE_ONLY])
def test_a_kill_while_tagging_rolling_back_or_cleaning_leaves_a_whole_city(
    name, old_city, tmp_path, truth, care_meetings, is_long
):
    for number in chosen(care_meetings[name], is_long):
        city, log = copy_of(old_city, tmp_path), tmp_path / "log"
        code, said = children.run(care(city), log, f"{name}:kill@{number}")
        assert code == children.KILLED, f"{name}@{number} was not met; {log.read_text()}"
        children.result(lambda city=city, said=said: cared_for(city, said, truth), log)


@pytest.mark.parametrize("name", IN_FOLDERS)
def test_a_kill_at_an_artifact_leaves_none_or_a_whole_one(name, city):
    log, work = city.root / "log", lambda acknowledge: acknowledge(city.save_space(seed=1))
    assert children.run(work, log, name) == (children.KILLED, [])
    (space_id,) = children.run(work, log)[1]
    spaces = [folder.name for folder in (city.workspace.caches / "artifacts").glob("spaces/[!.]*")]
    assert sorted(spaces) == sorted({space_id, children.result(lambda: city.save_space(seed=0), log)})


def test_a_kill_at_any_moment_loses_nothing(city, prepared, truth, is_long):
    seed = random.randrange(2**32)
    moments = random.Random(seed)
    started = time.monotonic()
    children.result(whole_run(copy_of(prepared, city.root.parent / "timed")), city.root / "log")
    whole_s = time.monotonic() - started
    for number in range(500 if is_long else 20):
        city = copy_of(prepared, city.root.parent)
        log = city.root.parent / "log"
        child = children.start(everything(city), log)
        time.sleep(moments.uniform(0, whole_s))
        child.signal(9)
        code, said = child.wait()
        assert code in (0, children.KILLED), f"seed {seed}, kill {number}: {log.read_text()}"
        survives(city, said, truth, log)


def test_the_same_drives_give_the_same_tiles_killed_or_not(city, prepared, truth):
    for number in range(3):
        city = copy_of(prepared, city.root.parent)
        log = city.root.parent / "log"
        children.run(everything(city), log, f"slab-before-write:kill@{1 + 7 * number}")
        assert children.result(whole_run(city), log) == truth
