"""How PreSight grows: what planning, publishing, reading and the catalog cost as cities, drives and generations grow.

python -m bench.scale growth|generations|day|catalog [OPTIONS] [--json FILE]
python -m bench.scale picture GROWTH_JSON GENERATIONS_JSON OUT_PNG

growth   real code on cities of growing size, without images and voxels (bench/scale_city.py); so is `generations`
day      one day of many cities against a real catalog, with stages that only take time (bench/scale_day.py)
catalog  what one call costs, on SQLite and PostgreSQL, by itself and with many writers
"""

import argparse
import json
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bench.scale_city import CITY, ScaleCity
from bench.scale_day import DAY_S, REPORT_S, Day, World
from flows.pace import COST_SHARE
from flows.status import current_status, json_line
from presight_core.priors import PriorReader
from presight_core.progress import Progress
from presight_core.recipes import Recipe
from storage.catalog import Catalog
from tests.servers import postgres_server

TILES, DRIVES, GENERATIONS = (25, 50, 100, 200, 400), (100, 200, 400, 800), (1, 4, 16, 64)
FIXED_TILES, FIXED_DRIVES = 100, 200  # while the other one grows
REPEATS = 3  # of a time; the least is kept
CALLS = 300  # of each kind, by one writer
WRITERS = (1, 4, 16)


def best(work: Callable[[], Any]) -> float:
    """The least time of a few, milliseconds."""
    times = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - started))
    return round(min(times), 2)


def city_times(folder: Path, tiles: int, drives: int) -> dict[str, float]:
    """All of one city of a size: milliseconds, and the bytes of its generation."""
    city = ScaleCity(folder, tiles)
    city.prepare()
    city.add_drives(0, drives)
    started = time.perf_counter()
    plan = city.plan()
    first = 1e3 * (time.perf_counter() - started)
    started = time.perf_counter()
    city.publish(plan)
    publish = 1e3 * (time.perf_counter() - started)
    url, store = city.workspace.catalog_url, city.workspace.store_location
    times = {"first plan": round(first, 1), "publish": round(publish, 1), "plan, nothing new": best(city.plan)}
    city.add_drives(drives, 1)
    started = time.perf_counter()
    city.plan()
    times["plan, one new drive"] = round(1e3 * (time.perf_counter() - started), 1)
    times["list the drive index"] = best(lambda: city.workspace.drives().drives())
    times["status --json"] = best(lambda: json_line(current_status(url, CITY)))
    times["open a reader"] = best(lambda: PriorReader.open(store, CITY))
    times["generation, kB"] = (folder / "store" / CITY / "generations/00000001.json").stat().st_size / 1e3
    return times


def generation_times(folder: Path) -> list[dict[str, float]]:
    """A city of many generations, of which each shows one new tile."""
    city = ScaleCity(folder, FIXED_TILES)
    city.prepare()
    city.add_drives(0, FIXED_DRIVES)
    city.publish(city.plan())
    rows, store, numbers = [], city.workspace.store(), city.workspace.store().generations(CITY)
    for wanted in GENERATIONS:
        while len(numbers) < wanted:
            shown = store.generation(CITY)
            assert shown is not None
            tile_id, tile = next(iter(shown.tiles.items()))
            started = time.perf_counter()
            store.publish(CITY, {tile_id: tile}, shown.number)
            publish = 1e3 * (time.perf_counter() - started)
            numbers = store.generations(CITY)
        row = {"generations": wanted, "publish one tile": round(publish, 1) if wanted > 1 else None}
        row["open a reader"] = best(lambda: PriorReader.open(city.workspace.store_location, CITY))
        row["plan, nothing new"] = best(city.plan)
        row["read all of them (log)"] = best(
            lambda: [store.generation(CITY, number) for number in store.generations(CITY)]
        )
        rows.append(row)
        print(row, flush=True)
    return rows


def growth(_: argparse.Namespace) -> dict[str, Any]:
    """Times by tiles and by drives."""
    sizes = [(tiles, FIXED_DRIVES) for tiles in TILES] + [(FIXED_TILES, drives) for drives in DRIVES]
    rows = []
    for tiles, drives in dict.fromkeys(sizes):
        with tempfile.TemporaryDirectory(prefix="presight-scale-") as folder:
            rows.append({"tiles": tiles, "drives": drives, **city_times(Path(folder) / "w", tiles, drives)})
        print(rows[-1], flush=True)
    return {"sizes": rows}


def generations(_: argparse.Namespace) -> dict[str, Any]:
    """Times by the number of generations."""
    with tempfile.TemporaryDirectory(prefix="presight-scale-") as folder:
        return {"generations": generation_times(Path(folder) / "w")}


def day(options: argparse.Namespace) -> dict[str, Any]:
    """One day; the catalog's file is in memory, so that no disk is measured."""
    world = World(options.cities, options.tiles, options.drives, options.gpus, options.tile_s)
    started = time.perf_counter()
    with tempfile.TemporaryDirectory(dir="/dev/shm") as folder:
        usage = Day(world, lambda clock: Catalog.open(f"sqlite:///{folder}/catalog.sqlite", clock)).run()
    rows = []
    for name, share in usage.busy_share().items():
        cost_ms = 1e3 * usage.seconds[name] / usage.made[name]
        rows.append({"call": name, "count": usage.calls[name], "ms": round(cost_ms, 3), "busy": round(share, 6)})
        print(rows[-1], flush=True)
    spans = sorted(usage.city_s)
    figures = {
        "world": asdict(world),
        "seconds_simulated_in": round(time.perf_counter() - started, 1),
        "stale_tiles": usage.stale,
        "gpu_hours": round(usage.stale * world.tile_s / 3600),
        "gpus_for_a_day": round(usage.stale * world.tile_s / DAY_S),
        "first_city_h": round(spans[0] / 3600, 2),
        "last_city_h": round(spans[-1] / 3600, 2),
        "longest_wait_for_a_gpu_h": round(max(usage.waited_s) / 3600, 2),
    }
    print(figures, flush=True)
    return {**figures, "calls": rows}


def catalog(_: argparse.Namespace) -> dict[str, Any]:
    """Milliseconds of a call and calls a second, on two databases."""
    with tempfile.TemporaryDirectory(prefix="presight-scale-") as folder:
        rows = _calls("SQLite", f"sqlite:///{folder}/catalog.sqlite")
    with postgres_server() as server:
        rows += _calls("PostgreSQL", server)
    return {"calls": rows}


def _calls(engine: str, url: str) -> list[dict[str, Any]]:
    opened, rows = Catalog.open(url), []
    recipe = Recipe("tile", 1, {}, {"drives": [f"{number:016x}" for number in range(40)]})
    lease = opened.leases.take("city", "bench:0:0:0", seconds=1e6)
    build = opened.start_build("city", "t000", recipe, lease)
    kinds: dict[str, Callable[[int], Any]] = {
        "report progress": lambda n: opened.progress(build, Progress("training", n, 10**9, {"loss": 0.1})),
        "renew a lease": lambda _: opened.leases.renew(lease, 1e6),
        "start a build": lambda n: opened.start_build("city", f"t{n:04}", recipe, lease),
    }
    for name, work in kinds.items():
        for writers in WRITERS if name == "report progress" else (1,):
            a_second = _rate(work, writers)
            rows.append({"database": engine, "call": name, "writers": writers, "a_second": round(a_second, 1)})
            print(rows[-1], flush=True)
    paced = a_second_of(rows, "report progress")
    print({"database": engine, "tiles at 2 reports a second": round(paced * REPORT_S), "share of a build": COST_SHARE})
    return rows


def a_second_of(rows: list[dict[str, Any]], call: str) -> float:
    """The most calls a second of a kind."""
    return max(row["a_second"] for row in rows if row["call"] == call)


def _rate(work: Callable[[int], Any], writers: int) -> float:
    """Calls a second of some writers together."""
    threads = [
        threading.Thread(target=lambda first=first: [work(first + n) for n in range(CALLS // writers)])
        for first in range(0, writers * CALLS, CALLS)
    ]
    started = time.perf_counter()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return CALLS // writers * writers / (time.perf_counter() - started)


def picture(options: argparse.Namespace) -> None:
    """The curves of `growth`, both axes logarithmic, with a line that is straight growth."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    rows = json.loads(options.growth.read_text()) | json.loads(options.generations.read_text())
    parts = (
        ("tiles", [row for row in rows["sizes"] if row["drives"] == FIXED_DRIVES], f"tiles ({FIXED_DRIVES} drives)"),
        ("drives", _at_tiles(rows["sizes"], FIXED_TILES), f"drives ({FIXED_TILES} tiles)"),
        ("generations", rows["generations"], f"generations ({FIXED_TILES} tiles, {FIXED_DRIVES} drives)"),
    )
    figure, axes = pyplot.subplots(1, 3, figsize=(13, 4.2), sharey=True, layout="constrained")
    colours: dict[str, str] = {}
    for axis, (key, points, label) in zip(axes, parts, strict=True):
        for name in [name for name in points[-1] if name not in ("tiles", "drives", "generations", "generation, kB")]:
            shown = [(row[key], row[name]) for row in points if row[name]]
            colour = colours.setdefault(name, f"C{len(colours)}")
            axis.plot(*zip(*shown, strict=True), colour, marker="o", markersize=3)
        ends = points[0][key], points[-1][key]
        axis.plot(ends, [3 * end / ends[0] for end in ends], "k:", linewidth=1)
        axis.set(xscale="log", yscale="log", xlabel=label)
        axis.set_xticks([row[key] for row in points], [str(row[key]) for row in points])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("milliseconds")
    lines = [pyplot.Line2D([], [], color=colour, label=name) for name, colour in colours.items()]
    straight = pyplot.Line2D([], [], color="k", linestyle=":", label="straight growth")
    figure.legend(handles=[*lines, straight], loc="outside lower center", ncols=5)
    figure.savefig(options.out, dpi=90)


def _at_tiles(rows: list[dict[str, Any]], tiles: int) -> list[dict[str, Any]]:
    return sorted((row for row in rows if row["tiles"] == tiles), key=lambda row: row["drives"])


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    for work in (growth, generations, day, catalog):
        command = commands.add_parser(work.__name__)
        command.set_defaults(work=work)
        command.add_argument("--json", type=Path)
        if work is day:
            for name, value in asdict(World()).items():
                command.add_argument(f"--{name.replace('_', '-')}", type=type(value), default=value)
    drawing = commands.add_parser("picture")
    drawing.set_defaults(work=picture, json=None)
    drawing.add_argument("growth", type=Path)
    drawing.add_argument("generations", type=Path)
    drawing.add_argument("out", type=Path)
    options = parser.parse_args()
    figures = options.work(options)
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
