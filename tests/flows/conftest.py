"""The `presight` command as a user starts it: a process of its own."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.flows.scheduler import Scheduler
from tests.servers import prefect_server
from tests.storage.catalogs import new_postgres
from tests.torture.toy_city import ToyCity

Presight = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="session")
def presight(tmp_path_factory) -> Presight:
    """Runs the command in a workspace and gives its result; what Prefect keeps goes to a temporary folder."""
    home = tmp_path_factory.mktemp("prefect")

    def run(workspace: Path, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
        environment = {**os.environ, "PREFECT_HOME": str(home)}
        command = [sys.executable, "-m", "flows.cli", "--workspace", workspace, *arguments]
        text = [str(part) for part in command]
        return subprocess.run(text, capture_output=True, text=True, check=False, env=environment)

    return run


@pytest.fixture(scope="session")
def new_city_template(tmp_path_factory) -> ToyCity:
    """A city of two drives that was never built."""
    folder = tmp_path_factory.mktemp("new-city")
    made = ToyCity(folder / "workspace", folder / "data", side_blocks=2)
    made.prepare()
    made.ingest()
    return made


@pytest.fixture(scope="session")
def city_template(new_city_template: ToyCity, tmp_path_factory) -> ToyCity:
    """The same city, both drives in its two published tiles."""
    made = copied(new_city_template, tmp_path_factory.mktemp("city"))
    assert made.build() == 1
    return made


@pytest.fixture
def city(city_template: ToyCity, tmp_path: Path) -> ToyCity:
    """A copy of the built city that a test may change."""
    return copied(city_template, tmp_path)


@pytest.fixture
def new_city(new_city_template: ToyCity, tmp_path: Path) -> ToyCity:
    """A copy of the new city that a test may build."""
    return copied(new_city_template, tmp_path)


def copied(city: ToyCity, folder: Path) -> ToyCity:
    """The city with a workspace of its own below the folder; its images stay where they are."""
    return replace(city, root=Path(shutil.copytree(city.root, folder / "workspace")))


@pytest.fixture(scope="session")
def scheduler(postgres: str, tmp_path_factory) -> Iterator[Scheduler]:
    """A real Prefect server; a worker starts with the first test that needs one."""
    folder = tmp_path_factory.mktemp("prefect")
    with prefect_server(folder, new_postgres(postgres, "prefect")) as server:
        made = Scheduler(server, folder)
        try:
            yield made
        finally:
            made.end_worker()
