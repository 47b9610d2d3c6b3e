"""Publishing: which of the built tiles may be shown, and the one generation that shows them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flows.acceptance import Built, judge
from flows.drives import choose_drives
from flows.jobs import Job
from flows.plan import CityPlan
from flows.reconcile import hold_city
from presight_core.config import load_city_settings
from presight_core.errors import InputError
from presight_core.failpoints import failpoint
from presight_core.priors.documents import Generation, GenerationTile
from storage.leases import Lease
from storage.restoration import remember_build
from storage.workspace import Workspace


def publish(
    workspace: Workspace,
    plan: CityPlan,
    built: list[Built],
    failed: dict[str, tuple[Job, str]],
    lease: Lease,
    accept: Sequence[str] = (),
) -> dict[str, Any]:
    """Publish what passes validation as one generation, and write every tile's end into the catalog.

    Tiles that `accept` names, or a pattern of it, may differ from their old builds as they like. Raises LeaseLostError
    or ConflictError, with nothing published, if the run was taken for dead meanwhile.
    """
    store, catalog = workspace.store(), workspace.catalog()
    old = store.generation(plan.city)
    accepted: list[Built] = []
    errors = {tile_id: error for tile_id, (_, error) in failed.items()}
    for unjudged in built:
        tile, problems = judge(store, plan, unjudged, old, accept)
        if problems:
            errors[tile.job.tile_id] = problems
            catalog.finish_build(tile.job.build_id, "failed", tile.metrics, problems)
        else:
            accepted.append(tile)
    number = plan.generation
    withdrawn = _withdrawn(plan, old, {tile.job.tile_id for tile in accepted})
    if accepted or withdrawn:
        names = {drive.drive_id: drive.name for drive in plan.drives}
        rows = {build.build_id: build for build in catalog.running(plan.city)}
        now = catalog.now()
        tiles: dict[str, GenerationTile | None] = {
            tile.job.tile_id: remember_build(tile.tile(names), rows.get(tile.job.build_id), now) for tile in accepted
        }
        tiles |= dict.fromkeys(withdrawn)
        failpoint("publish-before")
        # In this order: whoever takes the lease after this line raises the fence before they do anything else.
        catalog.leases.require(lease)
        number = store.publish(plan.city, tiles, plan.generation, plan.tiling.to_json(), lease.token)
        failpoint("publish-after")
        for tile in accepted:
            metrics = {**tile.metrics, "generation": number}
            catalog.finish_build(tile.job.build_id, "published", metrics, finished_at=now)
        for tile_id in withdrawn:
            catalog.withdraw_tile(plan.city, tile_id)
    for job, error in failed.values():
        catalog.finish_build(job.build_id, "failed", {}, error)
    return {
        "generation": number,
        "published": [tile.job.tile_id for tile in accepted],
        "failed": errors,
        "withdrawn": withdrawn,
    }


def roll_back(folder: Path, city: str, number: int) -> int:
    """Publish a generation that shows what an earlier one did; its number.

    Raises InputError if that contains a drive which was removed since, or belongs to the test part, LeaseHeldError
    while a run builds the city; else what `PriorStore.rollback` raises.
    """
    workspace = Workspace.open(folder)  # there may be a store and no catalog: then nothing is known to be removed
    split = load_city_settings(workspace.city_file(city)).split
    with hold_city(workspace, city):
        known, store = choose_drives(workspace.catalog().drive_records(city), split), workspace.store()
        old = store.generation(city, number)
        tiles = old.tiles if old else {}
        barred = sorted({why for tile in tiles.values() if (why := known.why_barred(tile.entry.drives))})
        if barred:
            raise InputError(f"{city}: generation {number} may not be shown again: {'; '.join(barred)}; build the city")
        return store.rollback(city, number)


def _withdrawn(plan: CityPlan, old: Generation | None, accepted: set[str]) -> dict[str, str]:
    """Shown tiles that contain a drive which no prior may contain, and were not built anew, with the reason.

    A hole in the prior is seen and mended; a drive that its owner took back, or that tests a model, must not stay.
    """
    shown = old.tiles if old else {}
    tainted = {tile_id: plan.known.why_barred(tile.entry.drives) for tile_id, tile in shown.items()}
    return {tile_id: why for tile_id, why in sorted(tainted.items()) if why and tile_id not in accepted}
