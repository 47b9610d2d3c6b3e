"""`presight plan`: what a build would do, what it costs by the builds of before, and what it leaves alone."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from flows.console import print_json, print_table
from flows.plan import CityPlan, TilePlan, plan_city, record_plan
from presight_core.config import load_city_settings
from storage.workspace import Workspace

COLUMNS = ("tile", "drives", "frames", "state", "why", "expected")


@dataclass(frozen=True)
class Cost:
    """What building the stale tiles takes."""

    rays: int
    seconds: float | None  # of tiles, one after the other; None if no tile of the city was ever built
    tile_seconds: dict[str, float]  # of each stale tile
    like_others: tuple[str, ...]  # tiles without a build of their own: they are taken to be as the others
    bytes: int | None  # that the new builds add to the store; the old ones stay for earlier generations
    drives_without_features: tuple[str, ...]  # whose images go through the networks first; their time is not counted


def forecast(workspace: Workspace, plan: CityPlan) -> Cost:
    """The cost of a plan. Time goes with the number of rays, disk stays what it was."""
    rays = plan.settings.training.steps * plan.settings.training.batch_rays
    rates = {tile.tile_id: rate for tile in plan.tiles if (rate := _seconds_per_ray(tile))}
    usual = sum(rates.values()) / len(rates) if rates else None
    seconds = {tile.tile_id: rays * rate for tile in plan.stale if (rate := rates.get(tile.tile_id, usual)) is not None}
    sizes = [tile.bytes for tile in plan.tiles if tile.bytes]
    usual_size = sum(sizes) / len(sizes) if sizes else None
    return Cost(
        rays=rays * len(plan.stale),
        seconds=sum(seconds.values()) if rates else None,
        tile_seconds=seconds,
        like_others=tuple(tile.tile_id for tile in plan.stale if tile.tile_id not in rates),
        bytes=None if usual_size is None else round(sum(tile.bytes or usual_size for tile in plan.stale)),
        drives_without_features=_without_features(workspace, plan),
    )


def _seconds_per_ray(tile: TilePlan) -> float | None:
    """How fast the tile's last published build went, training and extraction together."""
    seconds = tile.past.metrics.get("seconds") if tile.past else None
    if not tile.past or not seconds:
        return None
    try:
        training = tile.past.recipe["inputs"]["training"]["settings"]["training"]
        return seconds / (training["steps"] * training["batch_rays"])
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
    seconds = cost.tile_seconds.get(tile.tile_id)
    expected = "" if not tile.is_stale else "unknown" if seconds is None else f"{seconds:,.0f} s"
    state = "stale" if tile.is_stale else "current"
    return tile.tile_id, len(tile.drive_ids), tile.frame_count, state, "; ".join(tile.reasons), expected


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
    time = "time unknown (no past build)"
    if cost.seconds is not None:
        guessed = f", {len(cost.like_others)} of them taken to be as the others" if cost.like_others else ""
        time = f"about {cost.seconds:,.0f} s of tile time{guessed}"
    disk = f", about {cost.bytes / 1e6:,.1f} MB more in the store" if cost.bytes else ""
    first = len(cost.drives_without_features)
    features = f", features of {first} drives first" if first else ""
    return f"cost: {cost.rays / 1e6:,.1f} M rays, {time}{disk}{features}; next: presight build {plan.city}"
