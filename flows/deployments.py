"""What a Prefect server is told of a city: its deployments, their schedules, and what starts by itself.

A deployment is registered as FLOW/CITY. Rebuilds and updates of a city share a work queue that lets few of them begin;
that one builds at a time, and nothing twice, is the lease's doing (docs/decisions/014).
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import httpx
from prefect.client.orchestration import get_client
from prefect.utilities.callables import parameter_schema
from prefect.utilities.importtools import import_object

from flows.prefect_settings import require_server
from flows.schedules import AFTER_INGEST, BUILDING, FLOWS, Schedules
from presight_core.errors import ConflictError, SettingsError
from storage.workspace import Workspace

TAG = "presight"
ON_INGEST_TAG = "on-ingest"
BEGUN_AT_ONCE = 2  # runs of a city: one builds, one waits for its lease, or Prefect takes it to run though it is lost


def register(workspace: Workspace, city: str, schedules: Schedules) -> list[dict[str, Any]]:
    """Register every flow of the city, in place of what was registered before; what the server now has.

    Raises SettingsError if the server cannot be reached, ConflictError if the names belong to another workspace.
    """
    with _server() as server:
        _require_own(workspace, _registered(server, city))
        _ensure(server, "/work_pools/", {"name": schedules.pool, "type": "process"})
        _ensure(server, f"/work_pools/{schedules.pool}/queues/", {"name": city, "concurrency_limit": BEGUN_AT_ONCE})
        return [_register(server, workspace, city, flow, schedules) for flow in FLOWS]


def remove(workspace: Workspace, city: str) -> list[str]:
    """Take every deployment of the city away, and with them the runs that they scheduled; their names."""
    with _server() as server:
        known = _registered(server, city)
        _require_own(workspace, known)
        for deployment in known.values():
            server.request("DELETE", f"/deployments/{deployment['id']}")
            with _ignoring(404):
                server.request("DELETE", f"/work_pools/{deployment['work_pool_name']}/queues/{city}")
        return list(known)


def start_after_ingest(workspace: Workspace, cities: list[str]) -> dict[str, str]:
    """Start what `deploy --on-ingest` asked for: the id of the run of each city that has one.

    A run that has not begun yet will see the new drives, so that no second one is started.
    """
    runs = {}
    with _server() as server:
        for city in cities:
            deployment = _registered(server, city).get(f"{AFTER_INGEST}/{city}")
            if deployment and ON_INGEST_TAG in deployment["tags"] and _is_own(workspace, deployment):
                runs[city] = _waiting(server, deployment["id"]) or _start(server, deployment["id"])
    return runs


def _register(server: Any, workspace: Workspace, city: str, flow: str, schedules: Schedules) -> dict[str, Any]:
    cron = schedules.crons.get(flow)
    flow_id = server.request("POST", "/flows/", json={"name": flow}).json()["id"]
    starts_on_ingest = schedules.on_ingest and flow == AFTER_INGEST
    parameters = {"workspace": str(workspace.root), "city": city}
    if flow in BUILDING:
        parameters |= {"runner": schedules.machines.runner, "cluster": schedules.machines.cluster}
    timing = {"schedule": {"cron": cron, "timezone": schedules.timezone}, "active": True}
    asked = {
        "name": city,
        "flow_id": flow_id,
        "entrypoint": FLOWS[flow],
        "work_pool_name": schedules.pool,
        "parameters": parameters,
        "parameter_openapi_schema": parameter_schema(import_object(FLOWS[flow])).model_dump(mode="json"),
        "schedules": [timing] if cron else [],
        "tags": [TAG, ON_INGEST_TAG] if starts_on_ingest else [TAG],
        **({"work_queue_name": city} if flow in BUILDING else {}),
    }
    server.request("POST", "/deployments/", json=asked)
    when = {"cron": cron, "timezone": schedules.timezone if cron else None, "on_ingest": starts_on_ingest}
    return {"deployment": f"{flow}/{city}", **when, "pool": schedules.pool, "parameters": parameters}


def _registered(server: Any, city: str) -> dict[str, dict[str, Any]]:
    """The city's deployments on the server, by name."""
    known = {}
    for flow in FLOWS:
        with _ignoring(404):
            known[f"{flow}/{city}"] = server.request("GET", f"/deployments/name/{flow}/{city}").json()
    return known


def _is_own(workspace: Workspace, deployment: dict[str, Any]) -> bool:
    return deployment["parameters"].get("workspace") == str(workspace.root)


def _require_own(workspace: Workspace, known: dict[str, dict[str, Any]]) -> None:
    for name, deployment in known.items():
        if not _is_own(workspace, deployment):
            raise ConflictError(
                f"{name} is registered for workspace {deployment['parameters'].get('workspace')}; remove it first with "
                "`presight --workspace THAT deploy CITY --remove`, or use another Prefect server"
            )


def _ensure(server: Any, path: str, value: dict[str, Any]) -> None:
    """Make it on the server, unless something has its name."""
    with _ignoring(409):
        server.request("POST", path, json=value)


def _waiting(server: Any, deployment_id: str) -> str | None:
    """A run of the deployment that was started by hand or by an event, and does not run yet."""
    waiting = {
        "deployment_id": {"any_": [deployment_id]},
        "state": {"type": {"any_": ["SCHEDULED", "PENDING"]}},
    }
    runs = server.request("POST", "/flow_runs/filter", json={"flow_runs": waiting}).json()
    return next((run["id"] for run in runs if not run["auto_scheduled"]), None)


def _start(server: Any, deployment_id: str) -> str:
    state = {"type": "SCHEDULED", "name": "Scheduled"}
    return server.request("POST", f"/deployments/{deployment_id}/create_flow_run", json={"state": state}).json()["id"]


@contextmanager
def _server() -> Iterator[Any]:  # Prefect's client types each path as a literal
    """The Prefect server that the environment names."""
    url = require_server()
    try:
        with get_client(sync_client=True) as server:
            yield server
    except httpx.TransportError as error:
        cure = "start it, or correct PREFECT_API_URL (docs/schedules.md)"
        raise SettingsError(f"{url}: no Prefect server answers there ({error}); {cure}") from error
    except httpx.HTTPStatusError as error:
        raise SettingsError(f"{url}: the Prefect server refused: {error}") from error


@contextmanager
def _ignoring(status: int) -> Iterator[None]:
    try:
        yield
    except httpx.HTTPStatusError as error:
        if error.response.status_code != status:
            raise
