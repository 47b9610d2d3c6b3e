"""The catalog: which drives, tilings and builds there are. It holds the truth; everything else shows it.

Safe for many threads and processes at once. Time comes from the catalog's own clock; nothing else reads one.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Literal

from presight_core.errors import ConflictError, InputError, NotFoundError
from storage.database import Database, Query, open_database
from storage.leases import Clock, Lease, Leases, require_current, text_of
from storage.migrations import HEAD
from storage.tile_states import TileStates, record_end, record_progress, record_showing, record_start, record_withdrawal

if TYPE_CHECKING:  # these import numpy, which `presight status` has no time for
    from presight_core.drives import Drive, Reject
    from presight_core.progress import Progress
    from presight_core.recipes import Recipe
    from presight_core.tiles import Tiling

Ending = Literal["built", "published", "failed"]


@dataclass(frozen=True)
class DriveRecord:
    """A drive that the catalog knows, in its city or taken out of it. Times are UTC, ISO 8601."""

    drive: "Drive"
    added_at: str
    removed_at: str | None


@dataclass(frozen=True)
class Build:
    """One attempt to build a tile. Times are UTC, ISO 8601."""

    build_id: int
    city: str
    tile_id: str
    recipe: dict[str, Any]
    recipe_digest: str
    state: str  # "running", then "built" or "failed"; "published" after "built"; "withdrawn" if shown no more
    stage: str  # what it does, or did last
    done: int
    total: int  # 0: not yet known
    figures: dict[str, float]  # of the stage: loss, rays/s
    metrics: dict[str, Any]  # of the result
    error: str  # of a failed build
    started_at: str
    updated_at: str
    finished_at: str | None
    lease_token: int | None = None  # of the lease that it runs under


def utc_now() -> datetime:
    """The time of day."""
    return datetime.now(UTC)


class Catalog:
    """Drives, tilings and builds in one database."""

    def __init__(self, database: Database, clock: Clock = utc_now) -> None:
        self._database = database
        self._clock = clock
        self.leases = Leases(database, clock)
        self.tile_states = TileStates(database)

    @staticmethod
    def open(url: str, clock: Clock = utc_now) -> "Catalog":
        """The catalog at a SQLAlchemy URL, made or brought up to date if need be.

        Raises StoreError if it cannot be reached, is damaged, or was made by a newer version.
        """
        database = open_database(url)
        if database.revision() != HEAD:
            from storage.migrations.upgrade import upgrade

            upgrade(database)
        return Catalog(database, clock)

    @staticmethod
    def unchecked(url: str, clock: Clock = utc_now) -> "Catalog":
        """The catalog at a URL, unasked whether its schema is this version's: that takes a connection of its own.

        For reading where time counts. What then raises StoreError may be cured by `open`.
        """
        return Catalog(open_database(url), clock)

    def now(self) -> str:
        """The time by the catalog's clock, as it is recorded."""
        return self._now()

    def add_drive(self, drive: "Drive", rejects: "Sequence[Reject]" = (), added_at: str | None = None) -> bool:
        """Record a drive and what was refused of it; False if it is there already, then only its place is updated.

        A drive of the same scene, root and version with other content is replaced: it is removed from its city.
        Raises InputError for a drive without frames.
        """
        if not drive.frame_count:
            raise InputError(f"{drive.name}: no good frame; correct what its rejects name and ingest it again")
        now = added_at or self._now()
        with self._database.writing() as query:
            known = query("SELECT removed_at FROM drives WHERE drive_id = :drive_id", drive_id=drive.drive_id)
            query(REMOVE_DRIVES + SAME_SCENE, **asdict(drive), now=now)
            if known:
                query(REPLACE_DRIVE, **asdict(drive))
                return known[0]["removed_at"] is not None
            query(ADD_DRIVE, **asdict(drive), added_at=now)
            _add_rejects(query, drive.drive_id, rejects)
            return True

    def remove_drive(self, drive_id: str, removed_at: str | None = None) -> None:
        """Take a drive out of its city; its record stays. Raises NotFoundError if there is none."""
        with self._database.writing() as query:
            if not query("SELECT 1 FROM drives WHERE drive_id = :drive_id", drive_id=drive_id):
                raise NotFoundError(f"no drive {drive_id}; `presight status` lists what there is")
            query(REMOVE_DRIVES + "drive_id = :drive_id", drive_id=drive_id, now=removed_at or self._now())

    def drives(self, city: str | None = None) -> "list[Drive]":
        """The drives of a city, or of all, by capture time."""
        from presight_core.drives import Drive

        names = ", ".join(field.name for field in fields(Drive))
        with self._database.reading() as query:
            rows = query(
                f"SELECT {names} FROM drives WHERE removed_at IS NULL AND city = COALESCE(:city, city)"
                " ORDER BY start_us, drive_id",
                city=city,
            )
        return [Drive(**row) for row in rows]

    def drive_records(self, city: str | None = None) -> list[DriveRecord]:
        """Every drive that ever was in a city, or in any, also those taken out, by capture time."""
        from presight_core.drives import Drive

        with self._database.reading() as query:
            rows = query(DRIVE_RECORDS, city=city)
        times = [(row.pop("added_at"), row.pop("removed_at")) for row in rows]
        return [DriveRecord(Drive(**row), *both) for row, both in zip(rows, times, strict=True)]

    def cities(self) -> list[str]:
        """Every city with a drive, sorted."""
        with self._database.reading() as query:
            return sorted(row["city"] for row in query("SELECT DISTINCT city FROM drives WHERE removed_at IS NULL"))

    def add_rejects(self, drive_id: str, rejects: "Sequence[Reject]") -> None:
        """Record what a later stage refused of a drive; what is recorded already is not recorded twice."""
        with self._database.writing() as query:
            known = {tuple(row.values()) for row in query(REJECTS_OF_DRIVE, drive_id=drive_id)}
            new = [reject for reject in rejects if (reject.code, reject.file, reject.detail) not in known]
            _add_rejects(query, drive_id, new)

    def rejects(self, city: str | None = None) -> "list[Reject]":
        """What was refused of the drives of a city, or of all."""
        from presight_core.drives import Reject

        with self._database.reading() as query:
            return [Reject(**row) for row in query(REJECTS_OF_CITY, city=city)]

    def save_tiling(self, tiling: "Tiling", settings: Mapping[str, Any], created_at: str | None = None) -> None:
        """Record a tiling, or append its new tiles to the recorded one. The newest tiling is its city's.

        Raises ConflictError if a recorded tile would move or vanish.
        """
        with self._database.writing() as query:
            known = query(FIND_TILING, city=tiling.city, tiling_id=tiling.tiling_id)
            if known:
                number, tiles = known[0]["tiling_number"], query(TILES, number=known[0]["tiling_number"])
            else:
                tiles = []
                number = query(
                    ADD_TILING,
                    city=tiling.city,
                    tiling_id=tiling.tiling_id,
                    settings=json.dumps(settings, sort_keys=True),
                    created_at=created_at or self._now(),
                )[0]["tiling_number"]
            _require_unmoved(tiling, tiles)
            for place, tile in enumerate(tiling.tiles[len(tiles) :], start=len(tiles)):
                x_m, y_m = (float(value) for value in tile.centroid_m)
                query(ADD_TILE, number=number, place=place, tile_id=tile.tile_id, x_m=x_m, y_m=y_m)

    def tiling(self, city: str) -> "Tiling | None":
        """The city's tiling, if it has one."""
        from presight_core.tiles import Tile, Tiling

        with self._database.reading() as query:
            newest = query(NEWEST_TILING, city=city)
            if not newest:
                return None
            rows = query(TILES, number=newest[0]["tiling_number"])
        tiles = tuple(Tile(row["tile_id"], (row["x_m"], row["y_m"])) for row in rows)
        return Tiling(newest[0]["tiling_id"], city, tiles)

    def tiling_settings(self, city: str) -> dict[str, Any]:
        """The settings that the city's tiling was made with; empty if it has none."""
        with self._database.reading() as query:
            newest = query(NEWEST_TILING, city=city)
        return json.loads(newest[0]["settings"]) if newest else {}

    def tiling_created_at(self, city: str) -> str | None:
        """When the city's tiling was first recorded."""
        with self._database.reading() as query:
            newest = query(NEWEST_TILING, city=city)
        return newest[0]["created_at"] if newest else None

    def start_build(self, city: str, tile_id: str, recipe: "Recipe", lease: Lease | None = None) -> int:
        """Record the start of a build; its id. Raises LeaseLostError if the lease is no longer the city's."""
        values = {"city": city, "tile_id": tile_id, "recipe": json.dumps(recipe.to_json()), "digest": recipe.digest}
        with self._database.writing() as query:
            if lease:
                require_current(query, lease)
            token, now = lease.token if lease else None, self._now()
            record_start(query, city, tile_id, now)
            return query(START_BUILD, **values, token=token, now=now)[0]["build_id"]

    def progress(self, build_id: int, progress: "Progress") -> bool:
        """Record where a running build is; False for a build that has ended, which stays as it is."""
        values = {"stage": progress.stage, "done": int(progress.done), "total": int(progress.total)}
        values |= {"figures": json.dumps(progress.figures), "now": self._now()}
        with self._database.writing() as query:
            for build in query(PROGRESS, build_id=build_id, **values):
                record_progress(query, build, values)
                return True
            return False

    def finish_build(
        self,
        build_id: int,
        state: Ending,
        metrics: Mapping[str, Any] | None = None,
        error: str = "",
        finished_at: str | None = None,
    ) -> None:
        """Record a build's end, now or at a time told. `metrics` None leaves those recorded before.

        Raises NotFoundError for no such build, ConflictError for one that failed already: its run was taken for dead.
        """
        encoded = None if metrics is None else json.dumps(dict(metrics))
        with self._database.writing() as query:
            values = {"build_id": build_id, "state": state, "metrics": encoded, "error": error}
            now = finished_at or self._now()
            ended = query(FINISH_BUILD, **values, now=now)
            for row in ended:
                record_end(query, {**row, "recipe": json.loads(row["recipe"])}, json.loads(row["metrics"]), now)
            if not ended:
                if query("SELECT 1 FROM builds WHERE build_id = :build_id", build_id=build_id):
                    raise ConflictError(f"build {build_id} was ended before, as failed; run `presight build` again")
                raise NotFoundError(f"no build {build_id}; start it with start_build")

    def withdraw_tile(self, city: str, tile_id: str, lease: Lease | None = None) -> None:
        """Record that the city shows no build of a tile any more. Raises LeaseLostError if `lease` is over."""
        with self._database.writing() as query:
            if lease:
                require_current(query, lease)
            now = self._now()
            query(WITHDRAW, city=city, tile_id=tile_id, now=now)
            record_withdrawal(query, city, tile_id, now)

    def show_again(self, build: Build, lease: Lease | None = None) -> None:
        """Record that the city shows an earlier build of a tile; `build`: as the prior tells it, of unknown number.

        A build that the catalog never knew is left alone. Raises LeaseLostError if `lease` is over.
        """
        place = {"city": build.city, "tile_id": build.tile_id}
        with self._database.writing() as query:
            if lease:
                require_current(query, lease)
            for row in query(SHOW_BUILD, **place, started_at=build.started_at, digest=build.recipe_digest):
                query(HIDE_LATER, **place, build_id=row["build_id"])
                record_showing(query, vars(build))

    def builds(self, city: str, state: str | None = None) -> list[Build]:
        """The latest build of every tile of a city, by tile; of those in `state`, if given."""
        with self._database.reading() as query:
            rows = query(LATEST_BUILDS, city=city, state=state)
        return [_build(row) for row in rows]

    def restore_build(self, build: Build) -> None:
        """Record a build that ended long ago, under a number of its own."""
        values = {
            **vars(build),
            **{name: json.dumps(getattr(build, name)) for name in ("recipe", "figures", "metrics")},
        }
        with self._database.writing() as query:
            query(RESTORE_BUILD, **{name: value for name, value in values.items() if name != "build_id"})
            record_start(query, build.city, build.tile_id, build.started_at)
            record_end(query, vars(build), build.metrics, build.updated_at)

    def running(self, city: str) -> list[Build]:
        """Builds of a city that are not ended."""
        with self._database.reading() as query:
            return [_build(row) for row in query(RUNNING, city=city)]

    def orphans(self, city: str | None = None) -> list[Build]:
        """Running builds, of a city or of all, whose lease is over: nobody works on them, and nobody ever will."""
        with self._database.reading() as query:
            return [_build(row) for row in query(ORPHANS, city=city)]

    def _now(self) -> str:
        return text_of(self._clock())


def _add_rejects(query: Query, drive_id: str, rejects: "Sequence[Reject]") -> None:
    for reject in rejects:
        query(ADD_REJECT, drive_id=drive_id, **asdict(reject))


def _require_unmoved(tiling: "Tiling", rows: list[dict[str, Any]]) -> None:
    recorded = [(row["tile_id"], row["x_m"], row["y_m"]) for row in rows]
    given = [(tile.tile_id, *tile.centroid_m) for tile in tiling.tiles]
    if given[: len(recorded)] != recorded:
        fact = f"{tiling.city}: tiling {tiling.tiling_id} would move or drop tiles that it has"
        raise ConflictError(f"{fact}; append tiles only, or make a new tiling")


def _build(row: Mapping[str, Any]) -> Build:
    return Build(**{**row, **{name: json.loads(row[name]) for name in ("recipe", "figures", "metrics")}})


ADD_DRIVE = """
    INSERT INTO drives (drive_id, name, city, root, version, captured, frame_count, start_us, end_us, added_at)
    VALUES (:drive_id, :name, :city, :root, :version, :captured, :frame_count, :start_us, :end_us, :added_at)"""
DRIVE_RECORDS = "SELECT * FROM drives WHERE city = COALESCE(:city, city) ORDER BY start_us, drive_id"
REPLACE_DRIVE = """
    UPDATE drives SET name = :name, root = :root, version = :version, captured = :captured, removed_at = NULL
    WHERE drive_id = :drive_id"""
REMOVE_DRIVES = "UPDATE drives SET removed_at = :now WHERE removed_at IS NULL AND "
ADD_REJECT = """
    INSERT INTO rejects (drive_id, code, file, detail, cure, drive)
    VALUES (:drive_id, :code, :file, :detail, :cure, :drive)"""
SAME_SCENE = "root = :root AND version = :version AND name = :name AND drive_id <> :drive_id"
REJECTS_OF_DRIVE = "SELECT code, file, detail FROM rejects WHERE drive_id = :drive_id"
REJECTS_OF_CITY = """
    SELECT code, file, detail, cure, drive FROM rejects WHERE drive_id IN
    (SELECT drive_id FROM drives WHERE removed_at IS NULL AND city = COALESCE(:city, city)) ORDER BY reject_id"""
FIND_TILING = "SELECT tiling_number FROM tilings WHERE city = :city AND tiling_id = :tiling_id"
NEWEST_TILING = "SELECT * FROM tilings WHERE city = :city ORDER BY tiling_number DESC LIMIT 1"
ADD_TILING = """
    INSERT INTO tilings (city, tiling_id, settings, created_at)
    VALUES (:city, :tiling_id, :settings, :created_at) RETURNING tiling_number"""
TILES = "SELECT tile_id, x_m, y_m FROM tiles WHERE tiling_number = :number ORDER BY place"
ADD_TILE = """
    INSERT INTO tiles (tiling_number, place, tile_id, x_m, y_m) VALUES (:number, :place, :tile_id, :x_m, :y_m)"""
START_BUILD = """
    INSERT INTO builds (city, tile_id, recipe, recipe_digest, state, stage, done, total, figures, metrics, error,
                        started_at, updated_at, lease_token)
    VALUES (:city, :tile_id, :recipe, :digest, 'running', '', 0, 0, '{}', '{}', '', :now, :now, :token)
    RETURNING build_id"""
RESTORE_BUILD = """
    INSERT INTO builds (city, tile_id, recipe, recipe_digest, state, stage, done, total, figures, metrics, error,
                        started_at, updated_at, finished_at, lease_token)
    VALUES (:city, :tile_id, :recipe, :recipe_digest, :state, :stage, :done, :total, :figures, :metrics, :error,
            :started_at, :updated_at, :finished_at, :lease_token)"""
PROGRESS = """
    UPDATE builds SET stage = :stage, done = :done, total = :total, figures = :figures, updated_at = :now
    WHERE build_id = :build_id AND state = 'running' RETURNING city, tile_id"""
FINISH_BUILD = """
    UPDATE builds SET state = :state, metrics = COALESCE(:metrics, metrics), error = :error, updated_at = :now,
                      finished_at = :now
    WHERE build_id = :build_id AND state <> 'failed'
    RETURNING city, tile_id, state, error, metrics, recipe"""
WITHDRAW = """
    UPDATE builds SET state = 'withdrawn', updated_at = :now
    WHERE city = :city AND tile_id = :tile_id AND state = 'published'"""
SHOW_BUILD = """
    UPDATE builds SET state = 'published', updated_at = COALESCE(finished_at, updated_at) WHERE build_id =
    (SELECT MAX(build_id) FROM builds WHERE city = :city AND tile_id = :tile_id AND recipe_digest = :digest
     AND started_at = :started_at AND state IN ('published', 'withdrawn')) RETURNING build_id"""
HIDE_LATER = """
    UPDATE builds SET state = 'withdrawn'
    WHERE city = :city AND tile_id = :tile_id AND state = 'published' AND build_id > :build_id"""
LATEST_BUILDS = """
    SELECT * FROM builds WHERE build_id IN
    (SELECT MAX(build_id) FROM builds WHERE city = :city AND state = COALESCE(:state, state) GROUP BY tile_id)
    ORDER BY tile_id"""
RUNNING = "SELECT * FROM builds WHERE state = 'running' AND city = :city ORDER BY build_id"
ORPHANS = """
    SELECT builds.* FROM builds LEFT JOIN leases ON leases.city = builds.city
    WHERE builds.state = 'running' AND builds.city = COALESCE(:city, builds.city)
    AND (leases.token IS NULL OR builds.lease_token IS NULL OR builds.lease_token <> leases.token
         OR leases.ended_at IS NOT NULL)
    ORDER BY builds.build_id"""
