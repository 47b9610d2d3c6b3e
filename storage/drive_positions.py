"""Where the cameras of a city's drives were, in one file: a plan asks nothing else of most drives.

A drive's id is a digest of its poses, so that what is in the file stays true. It can be made again from the index.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import parquet

from storage.drives import METADATA_KEY, DriveIndex, write_whole


@dataclass(frozen=True)
class DrivePositions:
    """Camera centres of some drives, a row an image, drive by drive."""

    drive_ids: tuple[str, ...]
    drive: NDArray[np.int32]  # (N,) place in `drive_ids`, ascending
    positions: NDArray[np.float64]  # (N, 3) world metres
    is_keyframe: NDArray[np.bool_]  # (N,)

    def select(self, rows: NDArray) -> "DrivePositions":
        """The given rows: a boolean mask or an index array."""
        return DrivePositions(self.drive_ids, self.drive[rows], self.positions[rows], self.is_keyframe[rows])


def read_positions(index: DriveIndex, city: str, drive_ids: Sequence[str]) -> DrivePositions:
    """The positions of a city's drives, in the order of `drive_ids`; drives that the file lacks are added to it.

    Raises what `DriveIndex.frames` does.
    """
    file = index.folder / "positions" / f"{city}.parquet"
    known = _load(file)
    missing = sorted(set(drive_ids) - set(known.drive_ids))
    if missing:
        known = _join([known, *(_of_drive(index, drive_id) for drive_id in missing)])
        file.parent.mkdir(parents=True, exist_ok=True)
        write_whole(_to_arrow(known), file)
    if known.drive_ids == tuple(drive_ids):
        return known
    return _ordered(known, drive_ids)


def _of_drive(index: DriveIndex, drive_id: str) -> DrivePositions:
    positions, is_keyframe = index.positions(drive_id)
    return DrivePositions((drive_id,), np.zeros(len(positions), np.int32), positions, is_keyframe)


def _join(parts: Sequence[DrivePositions]) -> DrivePositions:
    firsts = np.cumsum([0, *(len(part.drive_ids) for part in parts)])
    return DrivePositions(
        tuple(drive_id for part in parts for drive_id in part.drive_ids),
        np.concatenate([part.drive + np.int32(first) for part, first in zip(parts, firsts, strict=False)]),
        np.concatenate([part.positions for part in parts]),
        np.concatenate([part.is_keyframe for part in parts]),
    )


def _ordered(known: DrivePositions, drive_ids: Sequence[str]) -> DrivePositions:
    """Only the given drives, in their order."""
    wanted = {drive_id: place for place, drive_id in enumerate(drive_ids)}
    places = np.array([wanted.get(drive_id, -1) for drive_id in known.drive_ids], np.int32)[known.drive]
    kept = np.flatnonzero(places >= 0)
    rows = kept[np.argsort(places[kept], kind="stable")]
    return DrivePositions(tuple(drive_ids), places[rows], known.positions[rows], known.is_keyframe[rows])


def _to_arrow(known: DrivePositions) -> pa.Table:
    columns = {"drive": known.drive, "is_keyframe": known.is_keyframe}
    columns |= {name: known.positions[:, axis] for axis, name in enumerate("xyz")}
    return pa.table(columns).replace_schema_metadata({METADATA_KEY: json.dumps(known.drive_ids).encode()})


def _load(file: Path) -> DrivePositions:
    """What the file holds; nothing if it is absent or damaged."""
    try:
        table = parquet.read_table(file)
        values = {name: np.array(table.column(name)) for name in table.column_names}
        positions = np.stack([values[name] for name in "xyz"], -1)
        drive_ids = tuple(json.loads(table.schema.metadata[METADATA_KEY]))
        return DrivePositions(drive_ids, values["drive"], positions, values["is_keyframe"])
    except (pa.ArrowException, OSError, KeyError, TypeError, ValueError):
        return DrivePositions((), np.empty(0, np.int32), np.empty((0, 3)), np.empty(0, np.bool_))
