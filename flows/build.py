"""`presight build` and `presight update`: plan, and run the flow only if something is stale."""

import os
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from flows.console import print_json
from flows.plan import CityPlan, plan_city
from flows.reconcile import reconcile
from presight_core.config import load_city_settings
from presight_core.errors import BuildError
from storage.workspace import Workspace

# The embedded Prefect server needs 14-29 s on a cold start, more on a busy machine; it reports to nobody.
PREFECT_ENVIRONMENT = {
    "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": "120",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "DO_NOT_TRACK": "1",
    "PREFECT_LOGGING_LEVEL": "CRITICAL",
}


@dataclass(frozen=True)
class Request:
    """What a user wants built."""

    city: str
    overrides: Sequence[str] = ()
    parallel: int | None = None  # tiles at once
    wait: bool = False
    accept: Sequence[str] = ()
    warm: bool = False  # `presight update`
    as_json: bool = False


def build_city(folder: Path, request: Request) -> None:
    """Build what is stale of a city and say what became of it.

    Raises BuildError if a tile failed, LeaseHeldError if another run builds the city and this one shall not wait.
    """
    started, city = time.monotonic(), request.city
    workspace = Workspace.open(folder).require()
    reconcile(workspace, city)
    plan = plan_city(workspace, city, load_city_settings(workspace.city_file(city), request.overrides))
    if not plan.is_current:
        if not request.wait:
            workspace.catalog().leases.require_free(city)  # said now, not after the flow took its time to start
        outcome = _run(workspace, plan, request)
    else:
        outcome = {"generation": plan.generation, "published": [], "failed": {}, "withdrawn": {}}
    outcome["seconds"] = round(time.monotonic() - started, 1)
    if request.as_json:
        print_json(outcome)
    else:
        _print(city, outcome)
    if outcome["failed"]:
        raise BuildError(
            f"{city}: {len(outcome['failed'])} tiles failed and keep their old state; see `presight status {city}`"
        )


def _run(workspace: Workspace, plan: CityPlan, request: Request) -> dict[str, Any]:
    for name, value in PREFECT_ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    from flows.city import Order, run_city
    from flows.display import watch_builds

    signal.signal(signal.SIGTERM, _exit)  # so that Prefect's embedded server ends with us
    print(f"{plan.city}: starting the flow", file=sys.stderr)
    order = Order(
        str(workspace.root),
        plan.city,
        request.overrides,
        wait=request.wait,
        accept=request.accept,
        warm=request.warm,
    )
    with watch_builds(workspace.catalog(), plan.city):
        return run_city(order, len(plan.stale), request.parallel)


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
