"""`presight ingest`: index the drives of a data set, all of them or none."""

import sys
from dataclasses import asdict
from pathlib import Path

from flows.console import print_json, progress_bars
from flows.deploy import announce_ingest
from presight_core.drives import Reject
from presight_core.errors import InputError
from stages.ingest import IngestedDrive, ingest_nuscenes
from stages.scene_choice import SceneChoice
from storage.workspace import Workspace

SHOWN_REJECTS = 20  # on the terminal; --json has them all


def ingest_root(
    folder: Path,
    root: Path,
    version: str,
    keep_going: bool,
    as_json: bool,
    choice: SceneChoice | None = None,
) -> None:
    """Ingest a data set, or the scenes of it that `choice` takes, and print what became of each drive.

    Raises InputError, with catalog and store unchanged, for tables that cannot be used, for bad frames unless
    `keep_going`, and where no drive has a good frame.
    """
    with progress_bars() as report:
        drives = list(ingest_nuscenes(root, version, report, choice=choice))
    usable = _usable(drives, keep_going)
    workspace = Workspace.open(folder)
    catalog, index = workspace.catalog(), workspace.drives()
    rows = []
    for ingested in usable:
        added_at = index.add(ingested.drive, ingested.frames, ingested.rejects, catalog.now())
        is_new = catalog.add_drive(ingested.drive, ingested.rejects, added_at)
        rows.append({**asdict(ingested.drive), "new": is_new, "rejects": [asdict(r) for r in ingested.rejects]})
    started = announce_ingest(workspace, sorted({row["city"] for row in rows if row["new"]}))
    if as_json:
        left_out = len(drives) - len(usable)
        print_json({"workspace": str(workspace.root), "drives": rows, "left_out": left_out, "started": started})
        return
    for row in rows:
        what = "new" if row["new"] else "already known"
        print(f"{row['city']}  {row['name']}  {row['frame_count']} frames  {len(row['rejects'])} rejects  {what}")
    new, left_out = sum(row["new"] for row in rows), len(drives) - len(usable)
    print(f"{len(rows)} drives, {new} new, {left_out} left out; next: presight plan {rows[0]['city']}")
    for city, run in started.items():
        print(f"{city}: the Prefect server brings it up to date in run {run}")


def _usable(drives: list[IngestedDrive], keep_going: bool) -> list[IngestedDrive]:
    """The drives with good frames, every reject named. Raises InputError if the rejects forbid going on."""
    rejects = [reject for drive in drives for reject in drive.rejects]
    for reject in rejects[:SHOWN_REJECTS]:
        print(_line(reject), file=sys.stderr)
    if len(rejects) > SHOWN_REJECTS:
        print(f"... and {len(rejects) - SHOWN_REJECTS} more lines", file=sys.stderr)
    usable = [drive for drive in drives if len(drive.frames)]
    if not usable:
        raise InputError("no drive has a usable frame; nothing was ingested: repair the files named above")
    if rejects and not keep_going:
        raise InputError(
            "bad frames; nothing was ingested: repair the files named above, or ingest the good ones with --keep-going"
        )
    return usable


def _line(reject: Reject) -> str:
    return f"{reject.code}: {reject.file}: {reject.detail}; {reject.cure}"
