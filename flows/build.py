"""`presight build`: plan, and run the flow only if something is stale."""

import signal
import sys
import time
from pathlib import Path
from typing import Any, NoReturn

from flows import prefect_settings
from flows.console import print_json
from flows.plan import CityPlan, plan_city
from flows.reconcile import reconcile
from presight_core.config import load_city_settings
from presight_core.errors import BuildError
from storage.workspace import Workspace


def build_city(
    folder: Path, city: str, overrides: list[str], parallel: int | None, as_json: bool, wait: bool = False
) -> None:
    """Build what is stale of a city and say what became of it.

    Raises BuildError if a tile failed, LeaseHeldError if another run builds the city and this one shall not wait.
    """
    started = time.monotonic()
    workspace = Workspace.open(folder).require()
    reconcile(workspace, city)
    plan = plan_city(workspace, city, load_city_settings(workspace.city_file(city), overrides))
    if not plan.is_current:
        if not wait:
            workspace.catalog().leases.require_free(city)  # said now, not after the flow took its time to start
        outcome = _run(workspace, plan, overrides, parallel, wait)
    else:
        outcome = {"generation": plan.generation, "published": [], "failed": {}, "withdrawn": {}}
    outcome["seconds"] = round(time.monotonic() - started, 1)
    if as_json:
        print_json(outcome)
    else:
        _print(city, outcome)
    if outcome["failed"]:
        raise BuildError(
            f"{city}: {len(outcome['failed'])} tiles failed and keep their old state; see `presight status {city}`"
        )


def _run(
    workspace: Workspace, plan: CityPlan, overrides: list[str], parallel: int | None, wait: bool
) -> dict[str, Any]:
    prefect_settings.prepare(log_level="CRITICAL")  # its word on a build is the catalog's, which we show
    from flows.city import run_city
    from flows.display import watch_builds

    signal.signal(signal.SIGTERM, _exit)  # so that Prefect's embedded server ends with us
    print(f"{plan.city}: starting the flow", file=sys.stderr)
    with watch_builds(workspace.catalog(), plan.city):
        return run_city(workspace, plan, overrides, parallel, wait)


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
