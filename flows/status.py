"""`presight status`: the state of every tile, from the catalog alone."""

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from flows.console import print_table
from presight_core.errors import InputError, NotFoundError, StoreError
from storage.catalog import Catalog
from storage.tile_states import CityDrives, CityTotal, TileState
from storage.workspace import Workspace

SCHEMA = 1  # of the JSON, as docs/cities.md describes it; raised when a name changes its meaning or goes
QUIET = "published"  # the state that needs nobody's attention
RUNNING = ("queued", "running", "built")
MOST_ROWS = 60  # of a table for people; --json has them all
WATCH_S = 1.0  # between two looks of --watch
CITY_COLUMNS = ("city", "tiles", "states", "drives", "voxels", "generation", "updated (UTC)", "plan")
TILE_NAMES = TileState._fields[: TileState._fields.index("stage_at")]  # what follows is for the time left
NO_DRIVES = CityDrives(0, "")
TILE_COLUMNS = ("tile", "state", "stage", "drives", "voxels", "PSNR dB", "generation", "age", "why")


@dataclass(frozen=True)
class Request:
    """What a user wants to see."""

    city: str | None = None
    tile: str | None = None
    watch: bool = False
    exit_code: bool = False
    as_json: bool = False


def show_status(folder: Path, request: Request) -> int:
    """Print what is asked for; the exit code, 0 unless it is asked for, too."""
    url = Workspace.open(folder).require().catalog_url
    while True:
        report = current_status(url, request.city, request.tile, None if request.as_json else MOST_ROWS)
        counts = _counts(report, request.tile)
        if request.as_json:
            print(json_line(report), flush=True)
        else:
            _print(report, request)
        if not (request.watch and any(counts[state] for state in RUNNING)):
            return exit_code(counts) if request.exit_code else 0
        time.sleep(WATCH_S)


def _counts(report: dict[str, Any], tile: str | None) -> Counter[str]:
    """Number of tiles in each state, of all that were asked for."""
    if tile is not None:
        return Counter([report["cities"][0]["tiles"][0]["state"]])
    return sum((Counter(city["states"]) for city in report["cities"]), Counter())


def exit_code(counts: Counter[str]) -> int:
    """6: a tile failed; 7: some are queued, running or built; 8: some are planned, stale or withdrawn; 0: none."""
    if counts["failed"]:
        return 6
    if any(counts[state] for state in RUNNING):
        return 7
    return 8 if counts.total() > counts[QUIET] else 0


def json_line(report: dict[str, Any]) -> str:
    """A report as JSON on one line."""
    import orjson  # ten times as fast as the standard library's, which takes longer for a large city than the query

    return orjson.dumps(report).decode()


def current_status(
    url: str, city: str | None = None, tile: str | None = None, most: int | None = None
) -> dict[str, Any]:
    """`status_of` the catalog at a URL; on a server in one connection, where opening it first would take two."""
    try:
        return status_of(Catalog.unchecked(url), city, tile, most)
    except StoreError:  # made by another version of the program, or not made yet
        return status_of(Catalog.open(url), city, tile, most)


def status_of(
    catalog: Catalog, city: str | None = None, tile: str | None = None, most: int | None = None
) -> dict[str, Any]:
    """The state of all cities, of one city with its tiles, or of one tile with its metrics.

    `most`: only so many tiles, those that need attention first. JSON values of the schema in docs/cities.md.
    Raises NotFoundError for a city or tile that there is not, InputError for a tile of no city.
    """
    if tile is not None and city is None:
        raise InputError(f"tile {tile}: every city may have one; run `presight status CITY --tile {tile}`")
    now = catalog.now()
    drives, totals, tiles, metrics = catalog.tile_states.snapshot(city, tile, most)
    names = sorted(drives.keys() | {total.city for total in totals})
    if city is not None and city not in names:
        raise NotFoundError(f"{city}: no such city here; known: {', '.join(catalog.cities()) or 'none'}")
    cities = [
        _city_values(name, drives.get(name, NO_DRIVES), [total for total in totals if total.city == name])
        for name in names
    ]
    if city is not None:
        if tile is not None and not tiles:
            raise NotFoundError(f"{city}: no tile {tile}; `presight status {city}` lists them")
        moment = datetime.fromisoformat(now)
        cities[0]["tiles"] = [_tile_values(each, moment) for each in tiles]
        if tile is not None:
            cities[0]["tiles"][0]["metrics"] = metrics
    return {"schema": SCHEMA, "at": now, "cities": cities}


def _city_values(name: str, drives: CityDrives, totals: Sequence[CityTotal]) -> dict[str, Any]:
    planned_at = max((total.planned_at or "" for total in totals), default="")
    return {
        "city": name,
        "states": {total.state: total.tile_count for total in totals},
        "drives": drives.drive_count,
        "voxels": sum(total.voxels or 0 for total in totals),
        "generation": max((total.generation or 0 for total in totals), default=0) or None,
        "updated_at": max((total.updated_at or "" for total in totals), default="") or None,
        "planned_at": planned_at or None,
        "plan_is_outdated": planned_at < drives.changed_at,  # a drive came or went since
    }


def _tile_values(tile: TileState, now: datetime) -> dict[str, Any]:
    values: dict[str, Any] = dict(zip(TILE_NAMES, tile, strict=False))
    values["percent"] = round(100 * tile.done / tile.total, 1) if tile.total else None
    values["eta_s"] = _eta_s(tile, now) if tile.state == "running" else None
    values["age_s"] = _seconds_since(tile.published_at, now) if tile.published_at else None
    return values


def _eta_s(tile: TileState, now: datetime) -> float | None:
    """Seconds until the stage ends, at the pace that it had so far."""
    if tile.stage_at is None or tile.updated_at is None or tile.done <= tile.stage_done:
        return None
    heard_of = datetime.fromisoformat(tile.updated_at)
    pace = _seconds_since(tile.stage_at, heard_of) / (tile.done - tile.stage_done)
    return round(max(0.0, pace * (tile.total - tile.done) - _seconds_since(tile.updated_at, now)), 1)


def _seconds_since(start: str, end: datetime) -> float:
    return (end - datetime.fromisoformat(start)).total_seconds()


def _print(report: dict[str, Any], request: Request) -> None:
    if request.watch:
        print("\033[H\033[2J", end="")  # home, clear
    if request.city is None:
        print_table(f"status at {_time(report['at'])}", CITY_COLUMNS, [_city_row(city) for city in report["cities"]])
        return
    (city,) = report["cities"]
    print(f"{city['city']}: {_states(city)}; {city['drives']} drives, generation {city['generation'] or 'none'}")
    if city["tiles"]:
        print_table("", TILE_COLUMNS, [_tile_row(tile) for tile in city["tiles"]])
    more = sum(city["states"].values()) - len(city["tiles"])
    if more and not request.tile:
        print(f"... and {more:,} more tiles; --json has them all")
    for name, value in (city["tiles"][0].get("metrics") or {}).items() if request.tile else ():
        print(f"  {name}: {value}")
    if city["plan_is_outdated"]:
        print(f"not planned since its drives changed; next: presight plan {city['city']}")


def _city_row(city: dict[str, Any]) -> tuple[object, ...]:
    plan = "outdated" if city["plan_is_outdated"] else "current"
    counts = city["generation"] or "", _time(city["updated_at"])
    return (city["city"], sum(city["states"].values()), _states(city), city["drives"], city["voxels"], *counts, plan)


def _tile_row(tile: dict[str, Any]) -> tuple[object, ...]:
    percent = "" if tile["percent"] is None else f" {tile['percent']:.0f} %"
    left = "" if tile["eta_s"] is None else f", {tile['eta_s']:.0f} s left"
    return (
        tile["tile_id"],
        tile["state"],
        f"{tile['stage']}{percent}{left}" if tile["state"] == "running" else "",
        tile["drive_count"],
        "" if tile["voxels"] is None else f"{tile['voxels']:,}",
        "" if tile["psnr_db"] is None else f"{tile['psnr_db']:.1f}",
        tile["generation"] or "",
        "" if tile["age_s"] is None else _duration(tile["age_s"]),
        tile["error"] or tile["reasons"],
    )


def _states(city: dict[str, Any]) -> str:
    return ", ".join(f"{count} {state}" for state, count in city["states"].items()) or "nothing built or planned yet"


def _time(text: str | None) -> str:
    return text[:19].replace("T", " ") if text else ""


def _duration(seconds: float) -> str:
    for unit, length in (("d", 86_400), ("h", 3_600), ("min", 60)):
        if seconds >= 2 * length:  # "119 min", then "2 h": never a lone one
            return f"{seconds / length:.0f} {unit}"
    return f"{seconds:.0f} s"
