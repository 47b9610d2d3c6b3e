"""Tiles on a Dask cluster: a scheduler and two workers, processes of their own, one of which is killed mid-tile."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.flows.scheduler import PATIENCE_S, Scheduler, eventually
from tests.flows.toy_worker import work_of
from tests.servers import free_ports
from tests.torture.toy_city import CITY, ToyCity

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(find_spec("prefect_dask") is None, reason="no Dask: pip install 'presight[dask]'"),
]

OFFER = "CPU=1 MEMORY=3"  # room for one tile of the preset demo at a time


class Cluster:
    """A Dask cluster on loopback."""

    def __init__(self, folder: Path, environment: dict[str, str]) -> None:
        self.address = f"tcp://127.0.0.1:{free_ports(1)[0]}"
        self.folder = folder
        self.environment = environment
        self._processes: list[subprocess.Popen] = []

    def start(self, *arguments: str) -> None:
        """Start `dask ARGUMENTS` in the background."""
        command = [sys.executable, "-m", "distributed.cli.dask_" + arguments[0], *arguments[1:]]
        with (self.folder / f"{arguments[0]}-{len(self._processes)}.log").open("wb") as log:
            started = subprocess.Popen(command, cwd=self.folder, env=self.environment, stdout=log, stderr=log)
        self._processes.append(started)

    def end(self) -> None:
        """End all of it."""
        for process in self._processes:
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path: Path, scheduler: Scheduler) -> Iterator[Cluster]:
    """A scheduler and two workers, each of which takes one tile at a time."""
    folder = tmp_path / "cluster"
    folder.mkdir()
    made = Cluster(folder, scheduler.environment)
    try:
        made.start("scheduler", "--host", made.address, "--no-dashboard", "--no-jupyter")
        for _ in range(2):
            made.start("worker", made.address, "--no-nanny", "--nthreads", "2", "--resources", OFFER, "--no-dashboard")
        yield made
    finally:
        made.end()


@pytest.fixture
def build(cluster: Cluster, new_city: ToyCity) -> Iterator[subprocess.Popen]:
    """A build on the cluster whose trainings do not end."""
    (new_city.root / "hold").touch()
    options = ["build", CITY, "--runner", "dask", "--cluster", cluster.address]
    command = [sys.executable, "-m", "flows.cli", "--workspace", str(new_city.root), *options]
    with (cluster.folder / "build.log").open("wb") as log:
        started = subprocess.Popen(command, env=cluster.environment, stdout=log, stderr=log)
    yield started
    started.kill()
    started.wait()


def test_a_worker_that_is_killed_mid_tile_costs_its_steps_and_nothing_else(cluster, build, new_city):
    catalog = new_city.workspace.catalog()
    first, second = eventually(lambda: len(work := work_of(new_city, "train")) == 2 and work)
    assert first["parent"] != second["parent"], "the two tiles went to the two workers"
    eventually(lambda: all(tile.done > 5 for tile in catalog.running(CITY)))
    os.kill(first["parent"], signal.SIGKILL)
    (new_city.root / "hold").unlink()  # so that the other worker has room again
    assert build.wait(PATIENCE_S) == 0
    (again,) = work_of(new_city, "train")[2:]
    assert (again["tile"], again["parent"]) == (first["tile"], second["parent"])
    assert again["step"] > 5, "it went on from where the killed one was"
    assert sorted(entry["tile"] for entry in work_of(new_city, "extract")) == ["t000", "t001"]
    assert new_city.workspace.store().generations(CITY) == [1]
    new_city.check_catalog()
    lost = {tile.tile_id: tile.metrics.get("lost_workers") for tile in catalog.builds(CITY, "published")}
    assert lost == {first["tile"]: 1, second["tile"]: None}


def test_a_cluster_that_can_never_build_a_tile_is_refused_with_what_it_needs(cluster, new_city, scheduler):
    options = ("--runner", "dask", "--cluster", cluster.address, "--set", "resources.gpus=1")
    result = scheduler.presight(new_city.root, "build", CITY, *options)
    assert result.returncode == 2
    assert "CPU=1 GPU=1 MEMORY=2" in result.stderr
