"""A run that died is found, ended as what it was, and shut out; two runs of a city never work at once."""

import subprocess
import sys
import threading
import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest

from flows.reconcile import hold_city, reconcile
from presight_core.errors import ConflictError, StoreError
from presight_core.priors.documents import GenerationTile
from presight_core.priors.example import ExampleTile
from presight_core.recipes import Recipe
from storage.leases import LeaseHeldError, LeaseLostError
from storage.tile_groups import TileName
from storage.workspace import Workspace

CITY, FAR = "toytown", "elsewhere:1:1:another machine"
RECIPE = Recipe("tile", 1, {}, {})
TILING = {"tiling_id": "tiling-1", "city": CITY, "tiles": [{"tile_id": "t000", "centroid_m": [0.0, 0.0]}]}


@pytest.fixture
def workspace(tmp_path) -> Workspace:
    opened = Workspace.open(tmp_path)
    opened.store().create_city(CITY, ExampleTile().lattice, "space-1", 8)
    return opened


def tile(workspace: Workspace) -> GenerationTile:
    example = ExampleTile(side_blocks=1)
    entry = workspace.store().write_tile(CITY, TileName("t000", "b1"), example.batches(), ["a", "b", "c"], {})
    return GenerationTile(entry, RECIPE.to_json(), {"metrics": {"psnr_db": 20.0}})


def lost_lease(workspace: Workspace):
    """A lease of a machine that was not heard of for long."""
    past = workspace.catalog()
    past.leases._clock = lambda: datetime.now(UTC) - timedelta(hours=1)
    return past.leases.take(CITY, FAR)


def test_a_second_run_is_refused_while_the_first_is_at_work(workspace):
    refused = pytest.raises(LeaseHeldError, match="wait for it with --wait")
    with hold_city(workspace, CITY), refused, hold_city(workspace, CITY):
        pass
    with hold_city(workspace, CITY) as lease:
        assert lease.token == 2


def test_a_second_run_waits_if_asked_to(workspace, capsys, monkeypatch):
    monkeypatch.setattr("flows.reconcile.POLL_S", 0.01)
    entered = threading.Event()

    def second() -> None:
        with hold_city(workspace, CITY, wait=True):
            entered.set()

    thread = threading.Thread(target=second)
    with hold_city(workspace, CITY):
        thread.start()
        assert not entered.wait(0.1)
    thread.join()
    assert entered.is_set()


def test_the_builds_of_a_lost_run_are_ended_as_failed(workspace):
    build_id = workspace.catalog().start_build(CITY, "t000", RECIPE, lost_lease(workspace))
    (ended,) = reconcile(workspace)
    assert (ended.build_id, ended.state) == (build_id, "failed")
    assert "ended without a word" in ended.error
    assert reconcile(workspace) == []


def test_a_run_that_died_after_its_generation_was_put_is_ended_as_published(workspace):
    lease = lost_lease(workspace)
    workspace.catalog().start_build(CITY, "t000", RECIPE, lease)
    workspace.store().publish(CITY, {"t000": tile(workspace)}, None, TILING, lease.token)
    (ended,) = reconcile(workspace)
    assert (ended.state, ended.metrics) == ("published", {"psnr_db": 20.0, "generation": 1})


def test_a_run_that_works_is_left_alone(workspace):
    with hold_city(workspace, CITY) as lease:
        workspace.catalog().start_build(CITY, "t000", RECIPE, lease)
        assert reconcile(workspace) == []
        assert workspace.catalog().builds(CITY)[0].state == "running"
    assert workspace.catalog().builds(CITY)[0].state == "failed"


def test_an_error_of_the_run_is_the_error_of_its_builds(workspace):
    with pytest.raises(ZeroDivisionError), hold_city(workspace, CITY) as lease:
        workspace.catalog().start_build(CITY, "t000", RECIPE, lease)
        raise ZeroDivisionError("by zero")
    assert "ZeroDivisionError: by zero" in workspace.catalog().builds(CITY)[0].error
    assert workspace.catalog().leases.lost() == []


def test_after_a_store_error_the_next_run_raises_the_fence(workspace):
    """A put without an answer may still be under way: only a newer generation in its place shuts it out."""
    with pytest.raises(StoreError), hold_city(workspace, CITY):
        raise StoreError("no answer")
    assert workspace.store().generations(CITY) == []
    catalog = workspace.catalog()
    catalog.leases._clock = lambda: datetime.now(UTC) + timedelta(hours=1)
    assert [lease.token for lease in catalog.leases.lost()] == [1]


def test_a_run_taken_for_dead_publishes_nothing_when_it_wakes(workspace):
    lease, written = lost_lease(workspace), tile(workspace)
    reconcile(workspace)
    with pytest.raises(LeaseLostError):
        workspace.catalog().leases.require(lease)
    with pytest.raises(ConflictError, match="taken for dead"):
        workspace.store().publish(CITY, {"t000": written}, None, TILING, lease.token)
    head = workspace.store().generation(CITY)
    assert head is not None
    assert (head.tiles, head.fence) == ({}, 2)


def test_a_new_catalog_beside_an_old_store_counts_on(workspace):
    workspace.store().raise_fence(CITY, 41)
    with hold_city(workspace, CITY) as lease:
        assert lease.token == 42


def test_a_heartbeat_keeps_a_long_run_alive(workspace):
    quick = replace(workspace, settings=workspace.settings.model_copy(update={"lease_s": 0.4}))
    with hold_city(quick, CITY) as lease:
        time.sleep(1.0)  # longer than the lease
        workspace.catalog().leases.require(lease)
        with pytest.raises(LeaseHeldError):
            workspace.catalog().leases.require_free(CITY)


def test_nobody_waits_for_a_killed_process_of_this_machine(workspace):
    code = (
        "import sys, os; from pathlib import Path; from flows.reconcile import hold_city;"
        "from storage.workspace import Workspace\n"
        f"with hold_city(Workspace.open(Path({str(workspace.root)!r})), {CITY!r}): print('held', flush=True); "
        "sys.stdin.read()"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"held\n"
        with pytest.raises(LeaseHeldError):
            workspace.catalog().leases.require_free(CITY)
        process.kill()
        process.wait()
        with hold_city(workspace, CITY) as lease:
            assert (lease.token, lease.follows_lost) == (2, True)
