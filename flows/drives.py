"""`presight drives`: which drives a city has, what each is for, and taking one out of every later prior."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from flows.console import print_json, print_table
from flows.reconcile import hold_city
from presight_core.config import SplitSettings, load_city_settings
from presight_core.drives import Drive
from presight_core.errors import InputError, NotFoundError
from presight_core.nuscenes_split import Role
from presight_core.split import part_of
from storage.catalog import DriveRecord
from storage.drives import DriveIndex
from storage.workspace import Workspace

COLUMNS = ("drive", "name", "city", "part", "captured", "frames", "added (UTC)", "removed (UTC)")


@dataclass(frozen=True)
class CityDrives:
    """The drives of a city by what may be done with them."""

    builders: tuple[Drive, ...]  # make the prior, by capture time
    parts: dict[str, Role]  # of every drive in the city, by id
    names: dict[str, str]  # of every drive that ever was there, by id
    barred: dict[str, str]  # drives that no prior may contain, by id, and why

    def why_barred(self, drive_ids: Sequence[str]) -> str:
        """Why a prior of these drives may not be shown; empty if it may."""
        return "; ".join(sorted(self.barred[drive_id] for drive_id in drive_ids if drive_id in self.barred))


def choose_drives(records: Sequence[DriveRecord], split: SplitSettings) -> CityDrives:
    """The drives of a city's records by the split. Raises SettingsError where the split does not tell."""
    present = [record.drive for record in records if record.removed_at is None]
    parts: dict[str, Role] = {drive.drive_id: part_of(drive.name, split) for drive in present}
    scenes = {_scene(drive): parts[drive.drive_id] for drive in present}
    barred = {}
    for drive in (record.drive for record in records):
        part = scenes.get(_scene(drive))  # a drive that a corrected one replaced has the part of that
        if part is None:
            barred[drive.drive_id] = f"drive {drive.name} was removed"
        elif part not in split.build_from:
            barred[drive.drive_id] = f"drive {drive.name} is of the {part} part"
    names = {record.drive.drive_id: record.drive.name for record in records}
    return CityDrives(tuple(drive for drive in present if drive.drive_id not in barred), parts, names, barred)


def require_split_apart(city: str, index: DriveIndex, known: CityDrives, split: SplitSettings) -> None:
    """Raise InputError, with the numbers, if train and test drives share ground and the split does not allow it."""
    if split.allow_overlap or not {"train", "test"} <= set(known.parts.values()):
        return
    import numpy as np

    from stages.overlap import overlap, require_apart

    train, test = ([drive for drive, part in known.parts.items() if part == role] for role in ("train", "test"))
    train_world = np.concatenate([index.positions(drive_id)[0] for drive_id in train])
    test_world = {known.names[drive_id]: index.positions(drive_id)[0] for drive_id in test}
    require_apart(city, overlap(train_world, test_world, split.overlap_m), split.overlap_m)


def remove_drive(workspace: Workspace, drive: str, wait: bool = False) -> tuple[Drive, list[str]]:
    """Take a drive, by name or id, out of its city; from here on no new generation contains it.

    The drive, and the tiles that are shown with it and stale now.
    It holds the city meanwhile, so that no build which planned with the drive publishes afterwards. Raises
    LeaseHeldError while one runs, unless `wait`; NotFoundError, InputError for a name that is none or two.
    """
    catalog = workspace.catalog()
    found = find_drive([record.drive for record in catalog.drive_records()], drive)
    with hold_city(workspace, found.city, wait):
        removed_at = catalog.now()
        with suppress(NotFoundError):  # caches that were cleared cannot bring it back either
            workspace.drives().mark_removed(found.drive_id, removed_at)
        catalog.remove_drive(found.drive_id, removed_at)
        generation = workspace.store().generation(found.city)
        shown = generation.tiles if generation else {}
        tiles = sorted(tile_id for tile_id, tile in shown.items() if found.drive_id in tile.entry.drives)
        catalog.tile_states.mark_stale(found.city, tiles, f"drive {found.name} was removed")
    return found, tiles


def find_drive(drives: Sequence[Drive], name_or_id: str) -> Drive:
    """The drive of an id, or of a name that only one drive has. Raises NotFoundError, or InputError for several."""
    found = [drive for drive in drives if name_or_id in (drive.drive_id, drive.name)]
    if not found:
        raise NotFoundError(f"no drive {name_or_id}; `presight drives list` names them all")
    if len(found) > 1:
        ids = ", ".join(f"{drive.drive_id} ({drive.city}, {drive.root})" for drive in found)
        raise InputError(f"{name_or_id}: {len(found)} drives have this name; say which: {ids}")
    return found[0]


def show_drives(folder: Path, city: str | None, as_json: bool) -> None:
    """Print the drives of a city, or of all, with their parts; removed ones, too."""
    workspace = Workspace.open(folder).require()
    records = workspace.catalog().drive_records(city)
    if not records:
        raise NotFoundError(f"{city or workspace.root}: no drives; `presight ingest` brings them")
    splits = {name: load_city_settings(workspace.city_file(name)).split for name in {r.drive.city for r in records}}
    rows = [_values(record, splits[record.drive.city]) for record in records]
    if as_json:
        print_json(rows)
        return
    keys = ("drive_id", "name", "city", "part", "captured", "frame_count", "added_at", "removed_at")
    print_table(str(workspace.root), COLUMNS, [[_cell(row[key]) for key in keys] for row in rows])


def show_removal(folder: Path, drive: str, wait: bool, as_json: bool) -> None:
    """Remove a drive and say which tiles contain it still."""
    workspace = Workspace.open(folder).require()
    removed, tiles = remove_drive(workspace, drive, wait)
    if as_json:
        print_json({"drive": asdict(removed), "stale": tiles})
        return
    print(f"{removed.city}: {removed.name} ({removed.drive_id}) removed; tiles that contain it: {', '.join(tiles)}")
    print(f"next: presight plan {removed.city}; presight build {removed.city}")


def _values(record: DriveRecord, split: SplitSettings) -> dict[str, Any]:
    part = None if record.removed_at else part_of(record.drive.name, split)
    return {**asdict(record.drive), "part": part, "added_at": record.added_at, "removed_at": record.removed_at}


def _cell(value: Any) -> object:
    text = "" if value is None else value
    return text[:19].replace("T", " ") if isinstance(text, str) and text.endswith("Z") else text


def _scene(drive: Drive) -> tuple[str, str, str]:
    return drive.root, drive.version, drive.name
