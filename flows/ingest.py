"""`presight ingest`: index the drives of a data set, all of them or none."""

import sys
from dataclasses import asdict
from pathlib import Path

from flows.console import print_json, progress_bars
from presight_core.drives import Reject
from presight_core.errors import InputError
from stages.ingest import IngestedDrive, ingest_nuscenes
from storage.workspace import Workspace

SHOWN_REJECTS = 20  # on the terminal; --json has them all


def ingest_root(folder: Path, root: Path, version: str, keep_going: bool, as_json: bool) -> None:
    """Ingest a data set and print what became of each drive.

    Raises InputError, with catalog and store unchanged, for tables that cannot be used, and for bad frames
    unless `keep_going`; a drive without a good frame is an error in any case.
    """
    with progress_bars() as report:
        drives = list(ingest_nuscenes(root, version, report))
    _refuse(drives, keep_going)
    workspace = Workspace.open(folder)
    catalog, index = workspace.catalog(), workspace.drives()
    rows = []
    for ingested in drives:
        index.add(ingested.drive, ingested.frames, ingested.rejects)
        is_new = catalog.add_drive(ingested.drive, ingested.rejects)
        rows.append({**asdict(ingested.drive), "new": is_new, "rejects": len(ingested.rejects)})
    if as_json:
        print_json({"workspace": str(workspace.root), "drives": rows})
        return
    for row in rows:
        what = "new" if row["new"] else "already known"
        print(f"{row['city']}  {row['name']}  {row['frame_count']} frames  {row['rejects']} rejects  {what}")
    cities = sorted({row["city"] for row in rows})
    new = sum(row["new"] for row in rows)
    print(f"{len(rows)} drives, {new} new; next: presight plan {cities[0] if cities else 'CITY'}")


def _refuse(drives: list[IngestedDrive], keep_going: bool) -> None:
    """Name every reject; raise if they forbid going on."""
    rejects = [reject for drive in drives for reject in drive.rejects]
    for reject in rejects[:SHOWN_REJECTS]:
        print(_line(reject), file=sys.stderr)
    if len(rejects) > SHOWN_REJECTS:
        print(f"... and {len(rejects) - SHOWN_REJECTS} more", file=sys.stderr)
    empty = [drive.drive.name for drive in drives if len(drive.frames) == 0]
    if empty:
        raise InputError(f"{', '.join(empty)}: no usable frame; nothing was ingested: repair the files named above")
    if rejects and not keep_going:
        raise InputError(
            f"{len(rejects)} bad frames; nothing was ingested: repair the files named above, or ingest the good frames "
            "with --keep-going"
        )


def _line(reject: Reject) -> str:
    return f"{reject.code}: {reject.file}: {reject.detail}; {reject.cure}"
