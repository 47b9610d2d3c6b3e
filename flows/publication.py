"""Publishing: which of the built tiles may be shown, and the one generation that shows them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flows.drives import choose_drives
from flows.jobs import Job
from flows.plan import CityPlan
from flows.reconcile import hold_city
from presight_core.config import load_city_settings
from presight_core.errors import InputError
from presight_core.failpoints import failpoint
from presight_core.priors.documents import Generation, GenerationTile, TileEntry
from stages.validation import validate_tile
from storage.leases import Lease
from storage.priors import PriorStore
from storage.restoration import remember_build
from storage.workspace import Workspace


@dataclass(frozen=True)
class Built:
    """A tile that was trained and extracted: its job and what the two workers said."""

    job: Job
    trained: dict[str, Any]
    extracted: dict[str, Any]

    @property
    def metrics(self) -> dict[str, Any]:
        """The tile's figures, for validation, the catalog and the generation."""
        entry, trained = self.extracted["entry"], self.trained["metrics"]
        counts = {f"extraction_{name}": count for name, count in self.extracted["counts"].items()}
        seconds = round(trained.get("seconds", 0.0) + self.extracted["seconds"], 1)
        return {**trained, **counts, "voxels": entry["voxel_count"], "bytes": entry["bytes"], "seconds": seconds}

    def tile(self, drive_names: Mapping[str, str] | None = None) -> GenerationTile:
        """The tile as a generation shows it, with the names of its drives by their ids."""
        entry, names = TileEntry.from_json(self.extracted["entry"]), drive_names or {}
        lineage = {"metrics": self.metrics, "drive_names": {drive: names.get(drive, "") for drive in entry.drives}}
        return GenerationTile(entry, self.job.recipe, lineage)


def publish(
    workspace: Workspace, plan: CityPlan, built: list[Built], failed: dict[str, tuple[Job, str]], lease: Lease
) -> dict[str, Any]:
    """Publish what passes validation as one generation, and write every tile's end into the catalog.

    Raises LeaseLostError or ConflictError, with nothing published, if the run was taken for dead meanwhile.
    """
    store, catalog = workspace.store(), workspace.catalog()
    old = store.generation(plan.city)
    accepted: list[Built] = []
    errors = {tile_id: error for tile_id, (_, error) in failed.items()}
    for tile in built:
        problems = _problems(store, plan, tile, old)
        if problems:
            errors[tile.job.tile_id] = "not published: " + "; ".join(problems)
            catalog.finish_build(tile.job.build_id, "failed", tile.metrics, errors[tile.job.tile_id])
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


def _problems(store: PriorStore, plan: CityPlan, tile: Built, old: Generation | None) -> tuple[str, ...]:
    """Why a built tile may not be published."""
    shown = old.tiles.get(tile.job.tile_id) if old else None
    barred = plan.known.why_barred(tile.tile().entry.drives)
    if barred:
        return (barred,)
    if shown and plan.known.why_barred(shown.entry.drives):
        shown = None  # what a barred drive alone saw is meant to be lost
    new_summary = store.summary(plan.city, tile.tile())
    old_summary = store.summary(plan.city, shown) if shown else None
    return validate_tile(new_summary, tile.metrics, old_summary, plan.settings.validation)
