"""The flows that a schedule or an event starts. Their parameters are references and settings of the run, never data.

A run that Prefect cancels ends itself in the catalog; one that dies is ended by who looks next (docs/decisions/009).
"""

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from prefect import flow

from flows.build import Request, bring_up_to_date, require_whole, run_flow
from flows.machines import Machines
from flows.reconcile import reconcile
from flows.store_care import opened as opened_store
from storage.retention import Retention, collect
from storage.workspace import Workspace


@flow(name="rebuild", flow_run_name="rebuild {city}", persist_result=False)
def rebuild(workspace: str, city: str, runner: str = "threads", cluster: str = "", wait: bool = True) -> dict[str, Any]:
    """Build and publish what is stale of a city, as `presight build`. Raises BuildError if a tile failed."""
    return _built(workspace, Request(city, machines=Machines(runner, cluster), wait=wait))


@flow(name="update", flow_run_name="update {city}", persist_result=False)
def update(workspace: str, city: str, runner: str = "threads", cluster: str = "", wait: bool = True) -> dict[str, Any]:
    """The same as `presight update`: tiles go on from the fields that they have."""
    return _built(workspace, Request(city, machines=Machines(runner, cluster), wait=wait, warm=True))


@flow(name="reconcile", flow_run_name="reconcile {city}", persist_result=False)
def reconcile_city(workspace: str, city: str) -> list[dict[str, Any]]:
    """End what dead runs left, as `presight reconcile`."""
    ended = reconcile(Workspace.open(Path(workspace)).require(), city)
    return [{"tile_id": build.tile_id, "state": build.state, "error": build.error} for build in ended]


@flow(name="gc", flow_run_name="gc {city}", persist_result=False)
def collect_garbage(workspace: str, city: str, keep: int = 20, grace_days: float = 7.0) -> dict[str, Any]:
    """Remove old generations and builds, as `presight gc`."""
    store, now = opened_store(Path(workspace), city), datetime.now(UTC)
    garbage = collect(store.location, city, Retention(keep, timedelta(days=grace_days)), now)
    return {"generations": len(garbage.generations), "builds": len(garbage.builds), "bytes": garbage.size_bytes}


def _built(workspace: str, request: Request) -> dict[str, Any]:
    outcome = bring_up_to_date(Workspace.open(Path(workspace)), request, run_flow)
    require_whole(request.city, outcome)
    return outcome
