"""Whether a built tile may be published: by itself, and against the build that it replaces."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from fnmatch import fnmatchcase
from typing import Any

from flows.jobs import Job
from flows.plan import CityPlan
from presight_core.priors.agreement import Agreement, agreement
from presight_core.priors.documents import Generation, GenerationTile, TileEntry
from presight_core.recipes import WARM_START
from stages.validation import judge_build, judge_change, psnr_change_db
from storage.priors import PriorStore


@dataclass(frozen=True)
class Built:
    """A tile that was trained and extracted: its job and what the two workers said."""

    job: Job
    trained: dict[str, Any]
    extracted: dict[str, Any]
    compared: dict[str, float] = field(default_factory=dict)  # figures against the build that it replaces

    @property
    def metrics(self) -> dict[str, Any]:
        """The tile's figures, for validation, the catalog and the generation."""
        entry, trained = self.extracted["entry"], self.trained["metrics"]
        counts = {f"extraction_{name}": count for name, count in self.extracted["counts"].items()}
        extraction_s = self.extracted["seconds"]
        seconds = round(trained.get("seconds", 0.0) + extraction_s, 1)
        lost = self.trained.get("lost_workers", 0) + self.extracted.get("lost_workers", 0)
        sizes = {"voxels": entry["voxel_count"], "bytes": entry["bytes"]}
        took = {"seconds": seconds, "extraction_seconds": extraction_s} | ({"lost_workers": lost} if lost else {})
        return {**trained, **counts, **sizes, **took, **self.compared}

    def tile(self, drive_names: Mapping[str, str] | None = None) -> GenerationTile:
        """The tile as a generation shows it, with the names of its drives by their ids."""
        entry, names = TileEntry.from_json(self.extracted["entry"]), drive_names or {}
        lineage = {"metrics": self.metrics, "drive_names": {drive: names.get(drive, "") for drive in entry.drives}}
        lineage["drive_psnr_db"] = self.trained.get("drive_psnr_db", {})
        return GenerationTile(entry, self.job.recipe, lineage)


def judge(
    store: PriorStore, plan: CityPlan, tile: Built, old: Generation | None, accept: Sequence[str] = ()
) -> tuple[Built, str]:
    """The tile with its figures against the old build, and why it may not be published; empty if it may."""
    barred = plan.known.why_barred(tile.tile().entry.drives)
    if barred:
        return tile, f"not published: {barred}"
    settings, new = plan.settings.validation, store.table(plan.city, tile.tile())
    problems = judge_build(int(new.block_start[-1]), tile.metrics, settings)
    shown = old.tiles.get(tile.job.tile_id) if old else None
    changes: tuple[str, ...] = ()
    if shown:
        agreed = agreement(store.table(plan.city, shown), new)
        change_db = psnr_change_db(shown.lineage.get("drive_psnr_db", {}), tile.trained.get("drive_psnr_db", {}))
        tile = replace(tile, compared=_figures(agreed, change_db))
        changes = judge_change(agreed, change_db, settings)
    if any(fnmatchcase(tile.job.tile_id, pattern) for pattern in accept):
        changes = ()
    if not problems and not changes:
        return tile, ""
    return tile, "not published: " + "; ".join([*problems, *changes]) + _cure(tile, bool(problems))


def _figures(agreed: Agreement | None, change_db: float | None) -> dict[str, float]:
    figures = {f"agreement_{name}": round(value, 4) for name, value in asdict(agreed).items()} if agreed else {}
    return figures if change_db is None else {**figures, "psnr_change_db": round(change_db, 3)}


def _cure(tile: Built, is_bad: bool) -> str:
    """What the user can do about a tile that differs too much from its old build."""
    city, tile_id = tile.job.city, tile.job.tile_id
    if is_bad:
        return ""
    is_warm = WARM_START in tile.job.training_recipe["inputs"]
    anew = f"train it from nothing with `presight build {city}`, or " if is_warm else ""
    return f"; {anew}publish it with `--accept {tile_id}`"
