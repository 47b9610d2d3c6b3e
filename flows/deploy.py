"""What `presight deploy` and `presight serve-flows` do and say."""

import sys
from pathlib import Path
from typing import Any, NamedTuple

from flows import prefect_settings
from flows.console import print_json, print_table
from flows.machines import Machines
from flows.schedules import Schedules, crons_from
from presight_core.errors import NotFoundError
from storage.workspace import Workspace


class Asked(NamedTuple):
    """What a user typed."""

    crons: list[str]
    timezone: str
    on_ingest: bool
    pool: str
    runner: str
    cluster: str


def register_city(folder: Path, city: str, asked: Asked, as_json: bool) -> None:
    """Register the city's flows and print what the server has now.

    Raises SettingsError for a bad schedule or server, NotFoundError for a city without drives.
    """
    prefect_settings.require_server()
    workspace = Workspace.open(folder).require()
    if city not in workspace.catalog().cities():
        raise NotFoundError(f"{city}: no drive of this city was ingested; `presight status` lists the cities")
    prefect_settings.prepare(log_level="WARNING")
    machines = Machines(asked.runner, asked.cluster)
    schedules = Schedules(crons_from(asked.crons), asked.timezone, asked.on_ingest, asked.pool, machines)
    from flows.deployments import register

    rows = register(workspace, city, schedules)
    if as_json:
        print_json(rows)
        return
    cells = [[row["deployment"], _when(row), row["pool"]] for row in rows]
    print_table(f"{city} on {prefect_settings.require_server()}", ["deployment", "starts", "pool"], cells)
    print(f"next: `presight serve-flows` on every machine that shall build; workspace {workspace.root}")


def remove_city(folder: Path, city: str, as_json: bool) -> None:
    """Take the city off the server and print what is gone."""
    prefect_settings.require_server()
    prefect_settings.prepare(log_level="WARNING")
    from flows.deployments import remove

    names = remove(Workspace.open(folder), city)
    if as_json:
        print_json(names)
    else:
        print(f"{city}: {', '.join(names) or 'nothing'} removed")


def announce_ingest(workspace: Workspace, cities: list[str]) -> dict[str, str]:
    """Start the updates that `deploy --on-ingest` asked for; run ids by city.

    The drives are safe by now, so that a server that does not answer is only told of.
    """
    if prefect_settings.server_url() is None:
        return {}
    prefect_settings.prepare(log_level="WARNING")
    from flows.deployments import start_after_ingest
    from presight_core.errors import SettingsError

    try:
        return start_after_ingest(workspace, cities)
    except SettingsError as error:
        print(f"the drives are ingested, but no update was started: {error}", file=sys.stderr)
        return {}


def serve(pool: str, limit: int | None) -> None:
    """Run a Prefect process worker until it is stopped."""
    url = prefect_settings.require_server()
    prefect_settings.prepare(log_level="INFO")
    import asyncio

    from prefect.workers.process import ProcessWorker

    print(f"serving pool {pool} of {url}", file=sys.stderr)
    asyncio.run(ProcessWorker(work_pool_name=pool, limit=limit).start())


def _when(row: dict[str, Any]) -> str:
    """When a deployment's runs start, for people."""
    times = [f"{row['cron']} ({row['timezone']})"] if row["cron"] else []
    return ", ".join([*times, *(["after ingest"] if row["on_ingest"] else [])]) or "by hand"
