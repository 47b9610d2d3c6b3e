"""`presight plan`: what a build would do, what it costs by the builds of before, and what it leaves alone."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from flows.console import print_json, print_table
from flows.plan import CityPlan, TilePlan, plan_city, record_plan
from presight_core.config import load_city_settings
from presight_core.recipes import WARM_START
from storage.workspace import Workspace

COLUMNS = ("tile", "drives", "frames", "state", "why", "build", "update", "update begins with")


@dataclass(frozen=True)
class Cost:
    """What building the stale tiles takes: from nothing, and as an update, which goes on from fields where it can."""

    rays: int
    seconds: float | None  # of tiles, one after the other; None if no tile of the city was ever built
    tile_seconds: dict[str, float]  # of each stale tile
    update_rays: int
    update_seconds: float | None
    update_tile_seconds: dict[str, float]
    like_others: tuple[str, ...]  # tiles without a build of their own: they are taken to be as the others
    bytes: int | None  # that the new builds add to the store; the old ones stay for earlier generations
    drives_without_features: tuple[str, ...]  # whose images go through the networks first; their time is not counted


@dataclass(frozen=True)
class Pace:
    """How fast a tile was built the last time."""

    seconds_per_ray: float  # of training and its evaluation
    extraction_s: float

    def seconds(self, rays: int) -> float:
        """What so many rays take, and the voxels after them."""
        return rays * self.seconds_per_ray + self.extraction_s


def forecast(workspace: Workspace, plan: CityPlan) -> Cost:
    """The cost of a plan. Training goes with the number of rays; extraction and disk stay what they were."""
    batch_rays = plan.settings.training.batch_rays
    cold = {tile.tile_id: batch_rays * plan.settings.training.steps for tile in plan.stale}
    warm = {tile.tile_id: batch_rays * tile.start.steps if tile.start else cold[tile.tile_id] for tile in plan.stale}
    paces = {tile.tile_id: pace for tile in plan.tiles if (pace := _pace(tile))}
    seconds, update_seconds = (_tile_seconds(rays, paces) for rays in (cold, warm))
    sizes = [tile.bytes for tile in plan.tiles if tile.bytes]
    usual_size = sum(sizes) / len(sizes) if sizes else None
    return Cost(
        rays=sum(cold.values()),
        seconds=sum(seconds.values()) if paces else None,
        tile_seconds=seconds,
        update_rays=sum(warm.values()),
        update_seconds=sum(update_seconds.values()) if paces else None,
        update_tile_seconds=update_seconds,
        like_others=tuple(tile.tile_id for tile in plan.stale if tile.tile_id not in paces),
        bytes=None if usual_size is None else round(sum(tile.bytes or usual_size for tile in plan.stale)),
        drives_without_features=_without_features(workspace, plan),
    )


def _tile_seconds(rays: Mapping[str, int], paces: Mapping[str, Pace]) -> dict[str, float]:
    """Seconds of each tile with so many rays, at its own pace or that of the others; none where there is no pace."""
    if not paces:
        return {}
    own = list(paces.values())
    usual = Pace(fmean(pace.seconds_per_ray for pace in own), fmean(pace.extraction_s for pace in own))
    return {tile_id: paces.get(tile_id, usual).seconds(count) for tile_id, count in rays.items()}


def _pace(tile: TilePlan) -> Pace | None:
    """The pace of the tile's last published build."""
    seconds = tile.past.metrics.get("seconds") if tile.past else None
    if not tile.past or not seconds:
        return None
    try:
        training = tile.past.recipe["inputs"]["training"]
        settings = training["settings"]["training"]
        steps = training["inputs"].get(WARM_START, settings)["steps"]
        extraction_s = tile.past.metrics.get("extraction_seconds", 0.0)
        return Pace((seconds - extraction_s) / (steps * settings["batch_rays"]), extraction_s)
    except KeyError:  # a recipe of an earlier version of the program
        return None


def _without_features(workspace: Workspace, plan: CityPlan) -> tuple[str, ...]:
    needed = sorted({drive_id for tile in plan.stale for drive_id in tile.drive_ids})
    cache = workspace.features()
    complete = {each for each in needed if plan.features and cache.is_complete(plan.features.digest, each)}
    return tuple(sorted(plan.known.names[drive_id] for drive_id in needed if drive_id not in complete))


def show_plan(folder: Path, city: str, overrides: list[str], as_json: bool) -> None:
    """Print the plan of a city."""
    workspace = Workspace.open(folder).require()
    plan = plan_city(workspace, city, load_city_settings(workspace.city_file(city), overrides))
    if not overrides:  # else it is not the plan of the city as it is set up
        record_plan(workspace, plan)
    cost = forecast(workspace, plan)
    if as_json:
        print_json(plan_json(plan, cost))
        return
    title = f"{city}: {len(plan.stale)} of {len(plan.tiles)} tiles to build"
    print_table(title, COLUMNS, [_row(tile, cost) for tile in plan.tiles])
    for line in plan.skipped:
        print(f"left out: {line}")
    for tile_id, why in plan.withdrawn.items():
        print(f"to withdraw: {tile_id}: {why}, and too few frames of other drives are left")
    print(untouched_line(plan))
    print(cost_line(plan, cost))


def _row(tile: TilePlan, cost: Cost) -> tuple[object, ...]:
    known = tile.tile_id, len(tile.drive_ids), tile.frame_count
    if not tile.is_stale:
        return *known, "current", "", "", "", ""
    expected = (cost.tile_seconds.get(tile.tile_id), cost.update_tile_seconds.get(tile.tile_id))
    times = ("unknown" if seconds is None else f"{seconds:,.0f} s" for seconds in expected)
    return *known, "stale", "; ".join(tile.reasons), *times, _begins_with(tile)


def _begins_with(tile: TilePlan) -> str:
    """What an update of a stale tile begins with, in words."""
    if tile.start is None:
        return ""
    if tile.start.is_warm:
        return f"its field, {tile.start.steps:,} steps"
    return "nothing" if tile.past is None else f"nothing: {tile.start.why_cold}"


def plan_json(plan: CityPlan, cost: Cost) -> dict[str, Any]:
    """The plan as JSON values; docs/cities.md describes them."""
    return {
        "city": plan.city,
        "generation": plan.generation,
        "drives": [drive.name for drive in plan.drives],
        "tiling": plan.tiling.to_json(),
        "space_id": plan.space_id,
        "left_out": list(plan.skipped),
        "withdrawn": plan.withdrawn,
        "untouched": [tile.tile_id for tile in plan.tiles if not tile.is_stale],
        "cost": asdict(cost),
        "tiles": [
            {
                "tile_id": tile.tile_id,
                "drives": list(tile.drive_ids),
                "frames": tile.frame_count,
                "stale": tile.is_stale,
                "reasons": list(tile.reasons),
                "kinds": sorted({cause.kind for cause in tile.causes}),
                "warm_steps": tile.start.steps if tile.start and tile.start.is_warm else None,
                "why_cold": tile.start.why_cold if tile.start else "",
                "seconds_last_time": tile.past.metrics.get("seconds") if tile.past else None,
                "voxels": tile.voxel_count,
            }
            for tile in plan.tiles
        ],
    }


def untouched_line(plan: CityPlan) -> str:
    """What a build leaves as it is."""
    kept = [tile for tile in plan.tiles if not tile.is_stale]
    if not kept:
        return "untouched: no tile"
    return f"untouched: {', '.join(tile.tile_id for tile in kept)} ({sum(t.voxel_count for t in kept):,} voxels)"


def cost_line(plan: CityPlan, cost: Cost) -> str:
    """What building the stale tiles takes, as far as past builds tell."""
    if plan.is_current:
        return f"nothing stale; generation {plan.generation} is current"
    stale, warm = len(plan.stale), sum(tile.start is not None and tile.start.is_warm for tile in plan.stale)
    guessed = f", {len(cost.like_others)} of them taken to be as the others" if cost.like_others else ""
    time = "time unknown (no past build)"
    if cost.seconds is not None:
        time = f"about {cost.seconds:,.0f} s of tile time{guessed}"
    disk = f", about {cost.bytes / 1e6:,.1f} MB more in the store" if cost.bytes else ""
    first = len(cost.drives_without_features)
    features = f", features of {first} drives first" if first else ""
    lines = [f"cost: {cost.rays / 1e6:,.1f} M rays, {time}{disk}{features}; next: presight build {plan.city}"]
    if warm:
        time = "" if cost.update_seconds is None else f", about {cost.update_seconds:,.0f} s"
        lines.append(
            f"or: {cost.update_rays / 1e6:,.1f} M rays{time}, where {warm} of {stale} tiles go on from the fields that "
            f"they have; next: presight update {plan.city}"
        )
    return "\n".join(lines)
