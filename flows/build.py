"""`presight build` and `presight update`: plan, and run the flow only if something is stale."""

import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from flows import prefect_settings
from flows.console import print_json
from flows.machines import HERE, Machines, crew_of
from flows.plan import CityPlan, plan_city
from flows.reconcile import reconcile
from presight_core.config import load_city_settings
from presight_core.errors import BuildError
from storage.workspace import Workspace

Run = Callable[[Workspace, CityPlan, "Request"], dict[str, Any]]


@dataclass(frozen=True)
class Request:
    """What a user wants built."""

    city: str
    overrides: Sequence[str] = ()
    machines: Machines = HERE
    wait: bool = False
    accept: Sequence[str] = ()
    warm: bool = False  # `presight update`
    as_json: bool = False


def build_city(folder: Path, request: Request) -> None:
    """Build what is stale of a city and say what became of it.

    Raises BuildError if a tile failed, LeaseHeldError if another run builds the city and this one shall not wait.
    """
    started = time.monotonic()
    outcome = bring_up_to_date(Workspace.open(folder), request, _run_watched)
    outcome["seconds"] = round(time.monotonic() - started, 1)
    if request.as_json:
        print_json(outcome)
    else:
        _print(request.city, outcome)
    require_whole(request.city, outcome)


def bring_up_to_date(workspace: Workspace, request: Request, run: Run) -> dict[str, Any]:
    """End what dead runs left, and `run` the flow if something is stale; what became of it."""
    reconcile(workspace.require(), request.city)
    settings = load_city_settings(workspace.city_file(request.city), request.overrides)
    plan = plan_city(workspace, request.city, settings)
    if plan.is_current:
        return {"generation": plan.generation, "published": [], "failed": {}, "withdrawn": {}}
    if not request.wait:
        workspace.catalog().leases.require_free(request.city)  # said now, not after the flow took its time to start
    return run(workspace, plan, request)


def run_flow(workspace: Workspace, plan: CityPlan, request: Request) -> dict[str, Any]:
    """Run the flow that builds the city."""
    from flows.city import Order, run_city

    order = Order(
        str(workspace.root),
        plan.city,
        request.overrides,
        wait=request.wait,
        accept=request.accept,
        warm=request.warm,
    )
    return run_city(order, crew_of(request.machines, plan.settings.resources, len(plan.stale)))


def require_whole(city: str, outcome: dict[str, Any]) -> None:
    """Raise BuildError if a tile failed."""
    if outcome["failed"]:
        raise BuildError(
            f"{city}: {len(outcome['failed'])} tiles failed and keep their old state; see `presight status {city}`"
        )


def _run_watched(workspace: Workspace, plan: CityPlan, request: Request) -> dict[str, Any]:
    prefect_settings.prepare(log_level="CRITICAL")  # what we show of a build is what the catalog says
    from flows.display import watch_builds

    signal.signal(signal.SIGTERM, _exit)  # so that Prefect's embedded server ends with us
    print(f"{plan.city}: starting the flow", file=sys.stderr)
    with watch_builds(workspace.catalog(), plan.city):
        return run_flow(workspace, plan, request)


def _exit(number: int, _frame: Any) -> NoReturn:
    sys.exit(128 + number)


def _print(city: str, outcome: dict[str, Any]) -> None:
    if not outcome["published"] and not outcome["failed"] and not outcome["withdrawn"]:
        print(f"{city}: nothing stale; generation {outcome['generation']} is current ({outcome['seconds']} s)")
        return
    for tile_id, error in outcome["failed"].items():
        print(f"{tile_id}: failed: {error.splitlines()[0]}")
    for tile_id, why in outcome["withdrawn"].items():
        print(f"{tile_id}: withdrawn, the prior has a hole there: {why}")
    tiles = ", ".join(outcome["published"]) or "no tile"
    print(f"{city}: published {tiles} as generation {outcome['generation']} ({outcome['seconds']} s)")
    print(f"next: presight status {city}; presight report {city}")
