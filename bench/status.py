"""Time `presight status` over 10,000 tiles and 10,000 drives, without the interpreter's start: SQLite and PostgreSQL.

python -m bench.status [TILES]
"""

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any

import sqlalchemy as sa

from flows.status import MOST_ROWS, current_status, json_line
from storage.catalog import Catalog
from storage.leases import text_of
from tests.servers import postgres_server

RUNS = 30
CITIES = 50
START = datetime(2026, 11, 22, tzinfo=UTC)
STATES = ("published", "published", "published", "running", "failed", "")


def fill(catalog: Catalog, cities: list[str], tiles: int) -> None:
    """Tiles and drives, spread over the cities."""
    rows = [_tile(cities[number % len(cities)], number) for number in range(tiles)]
    drives = [_drive(cities[number % len(cities)], number) for number in range(tiles)]
    metadata = sa.MetaData()
    engine = catalog._database.engine()
    metadata.reflect(engine, only=["tile_states", "drives"])
    with engine.begin() as connection:
        for table in ("tile_states", "drives"):
            connection.execute(sa.delete(metadata.tables[table]))
        connection.execute(sa.insert(metadata.tables["tile_states"]), rows)
        connection.execute(sa.insert(metadata.tables["drives"]), drives)
    if engine.dialect.name == "postgresql":
        with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            connection.execute(sa.text("VACUUM ANALYZE"))


def _tile(city: str, number: int) -> dict[str, Any]:
    state, time_of = STATES[number % len(STATES)], text_of(START + timedelta(seconds=number))
    values = {"city": city, "tile_id": f"t{number:05}", "state": state, "stage": "training" if state else ""}
    values |= {"done": 500, "total": 1000, "stage_at": time_of, "stage_done": 0}
    values |= {"error": "OutOfMemory: 12 GiB wanted" if state == "failed" else "", "planned_at": time_of}
    values |= {"reasons": "" if number % 7 else "drive scene-0061 added", "plan_digest": "0123456789abcdef"}
    values |= {"drive_count": 40, "frame_count": 9600, "started_at": time_of, "updated_at": time_of}
    values |= {"voxels": 3_000_000, "psnr_db": 23.5, "generation": 12, "published_at": time_of}
    return values


def _drive(city: str, number: int) -> dict[str, Any]:
    values = {"drive_id": f"{number:016}", "name": f"scene-{number}", "city": city, "root": "/data", "version": "v"}
    values |= {"captured": "2026-11-22", "frame_count": 240, "start_us": number, "end_us": number + 1}
    return values | {"added_at": text_of(START), "removed_at": None}


def measure(name: str, work: Callable[[], Any]) -> None:
    """Print the wall clock's median and least, and the process's own time."""
    walls, processor = [], time.process_time()
    for _ in range(RUNS):
        started = time.perf_counter()
        work()
        walls.append(1e3 * (time.perf_counter() - started))
    own = 1e3 * (time.process_time() - processor) / RUNS
    times = f"median {statistics.median(walls):6.1f} ms, least {min(walls):6.1f}, own CPU {own:6.1f}"
    print(f"{name:<44} {times}", flush=True)


def run(engine: str, url: str, tiles: int) -> None:
    """Measure on one database; every time includes opening the catalog, as a command does."""

    def ask(*arguments: Any) -> Callable[[], str]:
        return lambda: json_line(current_status(url, *arguments))

    catalog = Catalog.open(url)
    fill(catalog, [f"city-{number:02}" for number in range(CITIES)], tiles)
    measure(f"{engine}: {CITIES} cities, {tiles:,} tiles", ask())
    measure(f"{engine}: one of them, {tiles // CITIES} tiles", ask("city-07"))
    measure(f"{engine}: one tile", ask("city-07", "t00007"))
    fill(catalog, ["large"], tiles)
    measure(f"{engine}: a city of {tiles:,}, as for people", ask("large", None, MOST_ROWS))
    measure(f"{engine}: a city of {tiles:,}, all as JSON", ask("large"))


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000
    with tempfile.TemporaryDirectory() as folder:
        run("SQLite", f"sqlite:///{folder}/catalog.sqlite", count)
    with postgres_server() as server:
        run("PostgreSQL", server, count)
