"""`presight verify`, `log`, `tag` and `gc`: what a city's store says about itself."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from flows.console import print_json, print_table
from flows.reconcile import hold_city
from presight_core.errors import SettingsError, StoreError
from presight_core.priors.documents import Generation, generation_path
from storage.location import objects, open_store
from storage.priors import PriorStore
from storage.retention import Retention, collect, find_garbage
from storage.verification import verify_city
from storage.workspace import Workspace


def opened(folder: Path, city: str) -> PriorStore:
    """The store of a workspace. Raises NotFoundError if it has no such city."""
    store = PriorStore.open(Workspace.open(folder).store_location)
    store.city(city)
    return store


def show_faults(folder: Path, city: str, deep: bool, as_json: bool) -> None:
    """Print what is wrong with a city's store. Raises StoreError if anything is."""
    result = verify_city(Workspace.open(folder).store_location, city, deep)
    if as_json:
        print_json({**result.__dict__, "faults": [fault.__dict__ for fault in result.faults]})
    else:
        for fault in result.faults:
            print(f"{fault.path}: {fault.fact}")
        read = f"{result.chunks:,} chunks read" if deep else "chunks counted, not read (--deep reads them)"
        print(f"{city}: {result.generations} generations, {result.builds} builds, {read}, {len(result.faults)} faults")
    if result.faults:
        raise StoreError(f"{city}: {len(result.faults)} faults; restore the named objects from a copy, or rebuild")


def show_history(folder: Path, city: str, as_json: bool) -> None:
    """Print a city's generations, the newest first."""
    store = opened(folder, city)
    written = {entry.path: entry.modified for entry in objects(open_store(store.location), f"{city}/generations")}
    tags = store.tags(city)
    rows, before = [], None
    for number in store.generations(city):
        generation = store.generation(city, number)
        assert generation is not None  # only without a number
        names = [name for name, tagged in tags.items() if tagged == number]
        rows.append(
            _history_row(generation, before, names) | {"written": _time(written[generation_path(city, number)])}
        )
        before = generation
    if as_json:
        print_json(rows[::-1])
        return
    columns = ["generation", "written", "tiles", "voxels", "changed", "restores", "tags"]
    cells = [[" ".join(row[name]) if isinstance(row[name], list) else row[name] for name in columns] for row in rows]
    print_table(city, columns, [["" if cell is None else cell for cell in row] for row in cells[::-1]])


def _history_row(generation: Generation, before: Generation | None, tags: list[str]) -> dict[str, Any]:
    old = before.tiles if before else {}
    names = generation.tiles.keys() | old.keys()
    return {
        "generation": generation.number,
        "tiles": len(generation.tiles),
        "voxels": sum(tile.entry.voxel_count for tile in generation.tiles.values()),
        "changed": sorted(name for name in names if generation.tiles.get(name) != old.get(name)),
        "restores": generation.restores,
        "tags": tags,
    }


def change_tag(folder: Path, city: str, name: str | None, generation: int | None, remove: bool) -> None:
    """Set, take away, or show tags."""
    store = opened(folder, city)
    if name is None:
        if remove:
            raise SettingsError("--remove needs the name of a tag; `presight tag CITY` shows them")
        print_table(city, ["tag", "generation"], list(store.tags(city).items()))
    elif remove:
        store.remove_tag(city, name)
        print(f"{city}: tag {name} is gone")
    else:
        print(f"{city}: {name} is generation {store.tag(city, name, generation)}")


def clean(folder: Path, city: str, retention: Retention, dry_run: bool, as_json: bool) -> None:
    """Remove what a city no longer needs, or only show it. Raises LeaseHeldError while a run builds the city."""
    store = opened(folder, city)
    if dry_run:
        garbage = find_garbage(store.location, city, retention, datetime.now(UTC))
    else:
        with hold_city(Workspace.open(folder), city):  # nobody may publish or show again what goes just now
            garbage = collect(store.location, city, retention, datetime.now(UTC))
    if as_json:
        print_json({"generations": garbage.generations, "builds": garbage.builds, "bytes": garbage.size_bytes})
        return
    for path in garbage.builds:
        print(path)
    what = f"{len(garbage.generations)} generations and {len(garbage.builds)} builds, {garbage.size_bytes:,} bytes"
    print(f"{city}: {what} {'would go' if dry_run else 'are gone'}")


def _time(moment: datetime) -> str:
    return moment.astimezone(UTC).isoformat(timespec="seconds")
