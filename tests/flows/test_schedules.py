"""A real Prefect server and worker: schedules, events, and what is left when something dies (row R11)."""

import json
import os
import signal
from collections.abc import Iterator
from contextlib import suppress

import httpx
import pytest

from tests.flows.scheduler import Scheduler, eventually
from tests.flows.toy_worker import work_of
from tests.torture.toy_city import CITY, VERSION, ToyCity

pytestmark = pytest.mark.slow

REBUILD, UPDATE = f"rebuild/{CITY}", f"update/{CITY}"


@pytest.fixture
def forgetful(scheduler: Scheduler) -> Iterator[Scheduler]:
    """The server, which forgets the city after the test, however that ends."""
    yield scheduler
    for run in ("rebuild", "update", "reconcile", "gc"):
        with suppress(httpx.HTTPStatusError):
            scheduler.call("DELETE", f"/deployments/{scheduler.call('GET', f'/deployments/name/{run}/{CITY}')['id']}")


@pytest.fixture(scope="module")
def deployed(scheduler: Scheduler, new_city_template: ToyCity) -> Iterator[Scheduler]:
    """The server, which knows a city; a run is told in which copy of its workspace it works."""
    result = scheduler.presight(new_city_template.root, "deploy", CITY)
    assert result.returncode == 0, result.stderr
    yield scheduler
    scheduler.presight(new_city_template.root, "deploy", CITY, "--remove")


def started(scheduler: Scheduler, city: ToyCity) -> tuple[str, int]:
    """A run whose trainings do not end; its id and the process of its flow."""
    (city.root / "hold").touch()
    scheduler.start_worker()
    run = scheduler.start(REBUILD, workspace=str(city.root))
    eventually(lambda: all(build.done for build in city.workspace.catalog().running(CITY)) and work_of(city, "train"))
    return run, work_of(city, "train")[0]["parent"]


def release(city: ToyCity) -> None:
    """Let the trainings end."""
    (city.root / "hold").unlink(missing_ok=True)


def ingested_again(scheduler: Scheduler, city: ToyCity, scene: str) -> list[str]:
    """Remove a drive and take it in again; the runs that this started."""
    assert scheduler.presight(city.root, "drives", "remove", scene).returncode == 0
    result = scheduler.presight(city.root, "ingest", city.data, "--version", VERSION, "--json")
    return list(json.loads(result.stdout)["started"].values())


def of_type(scheduler: Scheduler, state: str) -> list[str]:
    """The runs of the rebuild that are in such a state."""
    return [run["id"] for run in scheduler.runs(REBUILD) if run["state_type"] == state]


def check_built_once(city: ToyCity) -> None:
    """One generation, made of what was built once, and a catalog that agrees with it."""
    city.check_catalog()
    assert city.workspace.store().generations(CITY) == [1]
    for what in ("train", "extract"):
        assert sorted(entry["tile"] for entry in work_of(city, what)) == ["t000", "t001"]


def check_ended(city: ToyCity) -> None:
    """The catalog calls the run failed, and its lease is over."""
    catalog = city.workspace.catalog()
    assert catalog.running(CITY) == []
    assert catalog.leases.current(CITY) is None
    assert {build.state for build in catalog.builds(CITY) if build.tile_id != "all tiles"} == {"failed"}
    assert city.check() == {}, "nothing is shown; whoever ends a lost run may have put a generation that fences it out"


def check_next_run(city: ToyCity) -> None:
    """The next run makes the city, and nothing was built twice into it."""
    release(city)
    city.build()
    city.check_catalog()
    assert sorted(city.check()) == ["t000", "t001"]


def test_a_schedule_builds_the_city_and_its_second_run_waits_and_its_third_does_not_begin(forgetful, new_city):
    scheduler = forgetful
    (new_city.root / "hold").touch()
    result = scheduler.presight(new_city.root, "deploy", CITY, "--cron", "* * * * *", "--json")
    registered = {row["deployment"]: row for row in json.loads(result.stdout)}
    machines = {"runner": "threads", "cluster": ""}
    assert registered[REBUILD]["parameters"] == {"workspace": str(new_city.root), "city": CITY, **machines}
    scheduler.start_worker()
    (first, *_) = eventually(lambda: scheduler.runs(REBUILD))
    assert first["auto_scheduled"]
    assert first["parameters"] == registered[REBUILD]["parameters"], "references are all that a run is given"
    scheduler.until(first["id"], "RUNNING")
    for _ in range(2):
        scheduler.start(REBUILD)
    begun = eventually(lambda: len(runs := of_type(scheduler, "RUNNING")) == 2 and runs)
    assert of_type(scheduler, "PENDING") == [], "the third one holds no process"
    release(new_city)
    assert [scheduler.until(run)["type"] for run in begun] == ["COMPLETED", "COMPLETED"]
    check_built_once(new_city)
    assert scheduler.presight(new_city.root, "deploy", CITY, "--remove").returncode == 0
    assert scheduler.presight(new_city.root, "deploy", CITY, "--remove").stdout == f"{CITY}: nothing removed\n"


def test_an_ingest_starts_an_update_and_a_second_one_before_it_begins_does_not(forgetful, new_city):
    forgetful.end_worker()
    assert forgetful.presight(new_city.root, "deploy", CITY, "--on-ingest").returncode == 0
    assert ingested_again(forgetful, new_city, "scene-0000") == [run["id"] for run in forgetful.runs(UPDATE)]
    (run,) = ingested_again(forgetful, new_city, "scene-0001")
    assert [run] == [run["id"] for run in forgetful.runs(UPDATE)]
    forgetful.start_worker()
    assert forgetful.until(run)["type"] == "COMPLETED"
    check_built_once(new_city)


def test_a_cancelled_run_is_ended_in_the_catalog(deployed, new_city):
    run, _ = started(deployed, new_city)
    deployed.call("POST", f"/flow_runs/{run}/set_state", {"state": {"type": "CANCELLING"}})
    assert deployed.until(run)["type"] == "CANCELLED"
    check_ended(new_city)
    check_next_run(new_city)


def test_a_killed_run_is_ended_in_the_catalog_by_reconcile(deployed, new_city):
    run, process = started(deployed, new_city)
    os.kill(process, signal.SIGKILL)
    assert deployed.until(run)["type"] == "CRASHED"
    assert deployed.presight(new_city.root, "reconcile").returncode == 0
    check_ended(new_city)
    check_next_run(new_city)


def test_a_run_whose_worker_is_killed_ends_itself_in_the_catalog(deployed, new_city):
    started(deployed, new_city)
    deployed.end_worker(signal.SIGKILL)
    release(new_city)  # what it says next has nobody to read it
    eventually(lambda: not new_city.workspace.catalog().running(CITY))
    check_ended(new_city)
    check_next_run(new_city)


def test_a_run_outlives_the_killed_server_and_the_next_run_builds_nothing_twice(deployed, new_city):
    started(deployed, new_city)
    deployed.server.end(signal.SIGKILL)
    release(new_city)
    eventually(lambda: new_city.workspace.store().generations(CITY))
    deployed.server.start()
    again = deployed.start(REBUILD, workspace=str(new_city.root))
    assert deployed.until(again)["type"] == "COMPLETED"
    check_built_once(new_city)


def test_a_run_that_the_server_does_not_know_of_is_refused_by_the_lease(deployed, new_city):
    run, _ = started(deployed, new_city)
    result = deployed.presight(new_city.root, "build", CITY)
    assert result.returncode == 5
    assert "builds it since" in result.stderr
    release(new_city)
    assert deployed.until(run)["type"] == "COMPLETED"
    check_built_once(new_city)


def test_a_lost_machine_leaves_a_run_to_prefect_and_none_to_the_catalog(deployed, new_city):
    run, process = started(deployed, new_city)
    deployed.end_worker(signal.SIGKILL)
    os.kill(process, signal.SIGKILL)
    result = deployed.presight(new_city.root, "reconcile", "--json")
    assert {row["state"] for row in json.loads(result.stdout)} == {"failed"}
    assert deployed.state(run)["type"] == "RUNNING", "Prefect believes it for ever"
    check_ended(new_city)
    check_next_run(new_city)
