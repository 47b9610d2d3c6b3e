"""Tile states: what `presight status` shows of each tile, a row a tile.

The rows are written in the transactions that write the builds, so that the two never disagree; reading them needs
neither the history of builds nor any JSON, which is what makes the status of ten thousand tiles quick.
"""

import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from presight_core.recipes import aim_of, digest_of
from storage.database import Database, Query

CITY_ROW = "all tiles"  # the row of work that belongs to no tile: the feature space and the features


class PlannedTile(NamedTuple):
    """What a plan says of a tile."""

    tile_id: str
    reasons: str  # empty: current
    digest: str  # of the recipe that a build would follow; empty while it is not known
    drive_count: int
    frame_count: int


class TileState(NamedTuple):
    """One tile. Times are UTC, ISO 8601. A tuple, as ten thousand of them are made at once."""

    tile_id: str
    state: str  # planned, queued, running, failed, built, published, stale or withdrawn
    stage: str  # of the newest build
    done: int
    total: int
    error: str  # first line
    reasons: str  # why it is stale or planned, as the last plan said
    drive_count: int
    frame_count: int
    started_at: str | None
    updated_at: str | None
    voxels: int | None  # this and the next three: of the build that the prior shows
    psnr_db: float | None
    generation: int | None
    published_at: str | None
    stage_at: str | None  # when its stage began
    stage_done: int  # how far the stage was then


class CityTotal(NamedTuple):
    """The tiles of one city that are in one state."""

    city: str
    state: str
    tile_count: int
    voxels: int | None
    generation: int | None  # the newest one that brought one of these tiles
    planned_at: str | None
    updated_at: str | None


class CityDrives(NamedTuple):
    """The drives of a city that ever had one."""

    drive_count: int  # in the city today
    changed_at: str  # when one last came or went


class Snapshot(NamedTuple):
    """What the catalog says at one moment."""

    drives: dict[str, CityDrives]  # by city
    totals: list[CityTotal]
    tiles: list[TileState]  # of the city that was asked for, none for all cities
    metrics: dict[str, Any]  # all figures of the build that is shown; of one tile only


class TileStates:
    """The tile states of one catalog."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def snapshot(self, city: str | None = None, tile_id: str | None = None, most: int | None = None) -> Snapshot:
        """Of all cities, of one with its tiles by name, or with one tile only.

        `most`: so many tiles at the most, and those first that are not published and current. All in one
        transaction: on a server it is the connecting that takes the time.
        """
        with self._database.reading() as query:
            drives = query(DRIVES_OF_CITY, city=city) if city else query(DRIVES)
            totals = query(TOTALS_OF_CITY, city=city) if city else query(TOTALS)
            tiles = _tiles(query, city, tile_id, most) if city else []
            metrics = query(SHOWN_METRICS, city=city, tile_id=tile_id) if tile_id else []
        present = {row["city"]: CityDrives(int(row["present"]), row["changed_at"]) for row in drives}
        figures = json.loads(metrics[0]["metrics"]) if metrics else {}
        return Snapshot(present, [CityTotal._make(row.values()) for row in totals], tiles, figures)

    def save_plan(self, city: str, tiles: Sequence[PlannedTile], now: str) -> None:
        """Record what a plan of a city says; tiles that it does not have and that never were built are forgotten."""
        with self._database.writing() as query:
            query("UPDATE tile_states SET reasons = '', plan_digest = '' WHERE city = :city", city=city)
            query("UPDATE tile_states SET planned_at = NULL WHERE city = :city", city=city)
            for tile in tiles:
                query(PLAN, city=city, now=now, **tile._asdict())
            query("DELETE FROM tile_states WHERE city = :city AND planned_at IS NULL AND state = ''", city=city)

    def mark_stale(self, city: str, tile_ids: Sequence[str], reason: str) -> None:
        """Say at once that shown tiles are stale, before anybody plans."""
        with self._database.writing() as query:
            for tile_id in tile_ids:
                query(MARK_STALE, city=city, tile_id=tile_id, reason=reason)


def _tiles(query: Query, city: str, tile_id: str | None, most: int | None) -> list[TileState]:
    if tile_id is not None:
        rows = query.tuples(ONE_TILE, city=city, tile_id=tile_id)
    elif most is not None:
        rows = query.tuples(NEWS_FIRST, city=city, most=most)
    else:
        rows = query.tuples(TILES_OF_CITY, city=city)
    return list(map(TileState._make, rows))


def record_start(query: Query, city: str, tile_id: str, now: str) -> None:
    """A build of a tile began."""
    query(START, city=city, tile_id=tile_id, now=now)


def record_progress(query: Query, build: Mapping[str, Any], values: Mapping[str, Any]) -> None:
    """The newest build of a tile went on; `values`: stage, done, total, now."""
    names = ("stage", "done", "total", "now")
    query(PROGRESS, city=build["city"], tile_id=build["tile_id"], **{name: values[name] for name in names})


def record_end(query: Query, build: Mapping[str, Any], metrics: Mapping[str, Any], now: str) -> None:
    """A build ended; `build`: city, tile_id, state, error, and recipe as JSON values."""
    place = {"city": build["city"], "tile_id": build["tile_id"], "now": now}
    first_line = build["error"].splitlines()[0] if build["error"] else ""
    query(END, **place, state=build["state"], error=first_line)
    if build["state"] == "published":
        shown = {name: metrics.get(name) for name in ("voxels", "psnr_db", "generation")}
        query(PUBLISH, **place, **shown, digest=digest_of(aim_of(build["recipe"])))  # a plan knows no more


def record_withdrawal(query: Query, city: str, tile_id: str, now: str) -> None:
    """The prior shows the tile no more."""
    query(WITHDRAW, city=city, tile_id=tile_id, now=now)


def record_showing(query: Query, build: Mapping[str, Any]) -> None:
    """The prior shows an earlier build of a tile; `build`: city, tile_id, metrics, recipe_digest, finished_at."""
    shown = {name: build["metrics"].get(name) for name in ("voxels", "psnr_db", "generation")}
    place = {"city": build["city"], "tile_id": build["tile_id"]}
    query(SHOW, **place, **shown, digest=build["recipe_digest"], published_at=build["finished_at"])


STATE = """
    CASE WHEN state = 'running' AND stage = '' THEN 'queued' WHEN state = '' THEN 'planned'
    WHEN state = 'published' AND reasons <> '' THEN 'stale' ELSE state END"""
COLUMNS = ", ".join(f"{STATE} AS state" if name == "state" else name for name in TileState._fields)
IS_SHOWN = f"NOT (tile_id = '{CITY_ROW}' AND state = 'built')"  # it is shown while it is news
TILES_OF_CITY = f"SELECT {COLUMNS} FROM tile_states WHERE city = :city AND {IS_SHOWN} ORDER BY tile_id"
NEWS_FIRST = f"""
    SELECT {COLUMNS} FROM tile_states WHERE city = :city AND {IS_SHOWN}
    ORDER BY CASE WHEN state = 'published' AND reasons = '' THEN 1 ELSE 0 END, tile_id LIMIT :most"""
ONE_TILE = f"SELECT {COLUMNS} FROM tile_states WHERE city = :city AND tile_id = :tile_id"
SHOWN_METRICS = """
    SELECT metrics FROM builds WHERE city = :city AND tile_id = :tile_id AND state = 'published'
    ORDER BY build_id DESC LIMIT 1"""
TOTALS = f"""
    SELECT city, {STATE} AS state, COUNT(*) AS tile_count, CAST(SUM(voxels) AS BIGINT) AS voxels,
           MAX(generation) AS generation, MAX(planned_at) AS planned_at, MAX(updated_at) AS updated_at
    FROM tile_states WHERE {IS_SHOWN} GROUP BY city, 2 ORDER BY city, 2"""
TOTALS_OF_CITY = TOTALS.replace("WHERE", "WHERE city = :city AND")
DRIVES = """
    SELECT city, SUM(CASE WHEN removed_at IS NULL THEN 1 ELSE 0 END) AS present,
           MAX(CASE WHEN removed_at > added_at THEN removed_at ELSE added_at END) AS changed_at
    FROM drives GROUP BY city"""
DRIVES_OF_CITY = DRIVES.replace("GROUP BY", "WHERE city = :city GROUP BY")
PLAN = """
    INSERT INTO tile_states (city, tile_id, reasons, plan_digest, drive_count, frame_count, planned_at)
    VALUES (:city, :tile_id, :reasons, :digest, :drive_count, :frame_count, :now)
    ON CONFLICT (city, tile_id) DO UPDATE SET reasons = excluded.reasons, plan_digest = excluded.plan_digest,
        drive_count = excluded.drive_count, frame_count = excluded.frame_count, planned_at = excluded.planned_at"""
MARK_STALE = "UPDATE tile_states SET reasons = :reason, plan_digest = '' WHERE city = :city AND tile_id = :tile_id"
START = """
    INSERT INTO tile_states (city, tile_id, state, started_at, updated_at)
    VALUES (:city, :tile_id, 'running', :now, :now)
    ON CONFLICT (city, tile_id) DO UPDATE SET state = 'running', stage = '', done = 0, total = 0, stage_at = NULL,
        stage_done = 0, error = '', started_at = excluded.started_at, updated_at = excluded.updated_at"""
PROGRESS = """
    UPDATE tile_states SET stage_at = CASE WHEN stage = :stage THEN stage_at ELSE :now END,
        stage_done = CASE WHEN stage = :stage THEN stage_done ELSE :done END,
        stage = :stage, done = :done, total = :total, updated_at = :now
    WHERE city = :city AND tile_id = :tile_id"""
END = """
    UPDATE tile_states SET state = :state, error = :error, updated_at = :now
    WHERE city = :city AND tile_id = :tile_id"""
PUBLISH = """
    UPDATE tile_states SET voxels = :voxels, psnr_db = :psnr_db, generation = :generation, published_at = :now,
        reasons = CASE WHEN plan_digest IN ('', :digest) THEN '' ELSE reasons END
    WHERE city = :city AND tile_id = :tile_id"""
SHOW = """
    UPDATE tile_states SET voxels = :voxels, psnr_db = :psnr_db, generation = :generation,
        published_at = :published_at, state = CASE WHEN state = 'withdrawn' THEN 'published' ELSE state END,
        reasons = CASE WHEN plan_digest = :digest THEN '' ELSE 'an earlier build is shown again' END
    WHERE city = :city AND tile_id = :tile_id"""
WITHDRAW = """
    UPDATE tile_states SET state = CASE WHEN state = 'published' THEN 'withdrawn' ELSE state END, voxels = NULL,
        psnr_db = NULL, generation = NULL, published_at = NULL, reasons = '', updated_at = :now
    WHERE city = :city AND tile_id = :tile_id"""
