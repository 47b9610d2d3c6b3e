"""Rows R2, R3 and R15 of docs/reliability.md: kill -9 at every named point, and at any moment."""

import random
import re
import time
from pathlib import Path

import pytest

from presight_core import failpoints
from tests.torture import children
from tests.torture.conftest import copy_of, whole_run
from tests.torture.toy_city import ToyCity

pytestmark = pytest.mark.slow

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


@pytest.fixture(scope="module")
def meetings(prepared, tmp_path_factory) -> dict[str, int]:
    """How often the pipeline meets every failpoint."""
    city = copy_of(prepared, tmp_path_factory.mktemp("counted"))

    def work(acknowledge) -> None:
        everything(city)(lambda _: None)
        acknowledge(dict(failpoints._met))

    code, said = children.run(work, city.root / "log", COUNT_ALL)
    assert code == 0, (city.root / "log").read_text()
    return said[-1]


def test_every_failpoint_is_somewhere_in_the_code():
    root = Path(__file__).resolve().parents[2]
    sources = [file for part in ("flows", "stages", "storage", "presight_core") for file in (root / part).rglob("*.py")]
    found = {name for file in sources for name in re.findall(r'failpoint\("([a-z-]+)"\)', file.read_text())}
    assert found == set(failpoints.NAMES)


@pytest.mark.parametrize("name", [name for name in failpoints.NAMES if not name.startswith("folder-")])
def test_a_kill_at_a_named_point_leaves_old_or_new_and_the_next_run_completes(
    name, city, prepared, truth, meetings, is_long
):
    """`folder-` points lie in the feature cache and the artifacts, which the toy city has from the start."""
    every = list(range(1, meetings[name] + 1))
    for number in every if is_long else sorted({1, (meetings[name] + 1) // 2, meetings[name]}):
        city = copy_of(prepared, city.root.parent)
        log = city.root.parent / "log"
        code, said = children.run(everything(city), log, f"{name}:kill@{number}")
        assert code == children.KILLED, f"{name}@{number} was not met; {log.read_text()}"
        survives(city, said, truth, log)


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
