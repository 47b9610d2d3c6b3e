"""Publishing: which of the built tiles may be shown, and the one generation that shows them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from flows.jobs import Job
from flows.plan import CityPlan
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
    accepted, errors = [], {tile_id: error for tile_id, (_, error) in failed.items()}
    for tile in built:
        problems = _problems(store, plan, tile, old)
        if problems:
            errors[tile.job.tile_id] = "not published: " + "; ".join(problems)
            catalog.finish_build(tile.job.build_id, "failed", tile.metrics, errors[tile.job.tile_id])
        else:
            accepted.append(tile)
    number = plan.generation
    if accepted:
        names = {drive.drive_id: drive.name for drive in plan.drives}
        rows = {build.build_id: build for build in catalog.running(plan.city)}
        now = catalog.now()
        tiles = {
            tile.job.tile_id: remember_build(tile.tile(names), rows.get(tile.job.build_id), now) for tile in accepted
        }
        failpoint("publish-before")
        # In this order: whoever takes the lease after this line raises the fence before they do anything else.
        catalog.leases.require(lease)
        number = store.publish(plan.city, tiles, plan.generation, plan.tiling.to_json(), lease.token)
        failpoint("publish-after")
        for tile in accepted:
            metrics = {**tile.metrics, "generation": number}
            catalog.finish_build(tile.job.build_id, "published", metrics, finished_at=now)
    for job, error in failed.values():
        catalog.finish_build(job.build_id, "failed", {}, error)
    return {
        "generation": number,
        "published": [tile.job.tile_id for tile in accepted],
        "failed": errors,
    }


def _problems(store: PriorStore, plan: CityPlan, tile: Built, old: Generation | None) -> tuple[str, ...]:
    """Why a built tile may not be published."""
    shown = old.tiles.get(tile.job.tile_id) if old else None
    new_summary = store.summary(plan.city, tile.tile())
    old_summary = store.summary(plan.city, shown) if shown else None
    return validate_tile(new_summary, tile.metrics, old_summary, plan.settings.validation)
