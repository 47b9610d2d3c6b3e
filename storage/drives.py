"""The drive index: one Parquet file a drive, a row a frame, with the drive and its rejects in the file's metadata.

The catalog can be made again from it.
"""

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from uuid import uuid4

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import parquet

from presight_core.drives import Drive, FrameTable, Reject
from presight_core.errors import NotFoundError, StoreError
from presight_core.failpoints import failpoint
from storage.folders import force_to_disk

FORMAT = 1  # of the columns and metadata below
METADATA_KEY = b"presight"
SHAPES = {"intrinsics": (3, 3), "world_from_camera": (4, 4)}  # matrices are stored as fixed-size lists, row by row
TEXTS = ("drive_id", "camera", "path")


class DriveIndex:
    """Frames of drives, in a folder. Writers and readers may be many: a file appears whole or not at all."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def add(self, drive: Drive, frames: FrameTable, rejects: Sequence[Reject] = (), added_at: str = "") -> str:
        """Write a drive's file, unless the same is there already; when it was first added.

        A drive that was marked as removed is so no more. Raises StoreError if the disk refuses.
        """
        self._removed(drive.drive_id).unlink(missing_ok=True)
        added_at = self.added_at(drive.drive_id) or added_at
        if self._has_same(drive, rejects):
            return added_at
        description = {
            "format": FORMAT,
            "drive": asdict(drive),
            "rejects": [asdict(reject) for reject in rejects],
            "added_at": added_at,
        }
        table = _to_arrow(frames).replace_schema_metadata({METADATA_KEY: json.dumps(description).encode()})
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_whole(table, self._file(drive.drive_id))
        except OSError as error:
            raise StoreError(f"{self.folder}: drive {drive.name} not written: {error}; free the disk") from error
        return added_at

    def added_at(self, drive_id: str) -> str:
        """When a drive was first added, UTC in ISO 8601; empty if nobody wrote it down, or there is no such drive."""
        try:
            return self._description(drive_id).get("added_at", "")
        except (NotFoundError, StoreError):
            return ""

    def mark_removed(self, drive_id: str, removed_at: str) -> None:
        """Write down that a drive was taken out of its city: it must not come back with the catalog."""
        self._existing(drive_id)
        self._removed(drive_id).write_text(removed_at, encoding="utf-8")

    def removed_at(self, drive_id: str) -> str | None:
        """When a drive was taken out of its city, if it was."""
        file = self._removed(drive_id)
        return file.read_text(encoding="utf-8") if file.is_file() else None

    def frames(self, drive_id: str) -> FrameTable:
        """The frames of a drive, ordered by camera and time. Raises NotFoundError, or StoreError if damaged."""
        return FrameTable(**self._columns(drive_id, [field.name for field in fields(FrameTable)]))

    def positions(self, drive_id: str) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Camera centres (N, 3) of a drive's frames, world metres, and which are keyframes; quicker than `frames`."""
        columns = self._columns(drive_id, ["world_from_camera", "is_keyframe"])
        return columns["world_from_camera"][:, :3, 3].copy(), columns["is_keyframe"]

    def _columns(self, drive_id: str, names: list[str]) -> dict[str, NDArray]:
        file = self._existing(drive_id)
        try:
            with parquet.ParquetFile(file) as source:  # `read_table` takes three times as long to open a file
                table = source.read(names, use_threads=False)
            return {name: _values(name, table.column(name)) for name in names}
        except (pa.ArrowException, OSError, KeyError, ValueError) as error:
            raise _damaged(file, error) from error

    def drives(self) -> list[Drive]:
        """Every drive of the index, by id."""
        return [self.drive(file.stem) for file in sorted(self.folder.glob("*.parquet"))]

    def drive(self, drive_id: str) -> Drive:
        """One drive. Raises NotFoundError, or StoreError if its file is damaged."""
        return Drive(**self._description(drive_id)["drive"])

    def rejects(self, drive_id: str) -> tuple[Reject, ...]:
        """What ingest refused of a drive."""
        return tuple(Reject(**reject) for reject in self._description(drive_id)["rejects"])

    def remove(self, drive_id: str) -> None:
        """Delete a drive's file, if there is one."""
        self._file(drive_id).unlink(missing_ok=True)

    def _has_same(self, drive: Drive, rejects: Sequence[Reject]) -> bool:
        try:
            return self.drive(drive.drive_id) == drive and self.rejects(drive.drive_id) == tuple(rejects)
        except (NotFoundError, StoreError):
            return False

    def _description(self, drive_id: str) -> dict:
        file = self._existing(drive_id)
        try:
            description = json.loads(parquet.read_schema(file).metadata[METADATA_KEY])
        except (pa.ArrowException, OSError, KeyError, TypeError, ValueError) as error:
            raise _damaged(file, error) from error
        if description["format"] != FORMAT:
            raise StoreError(f"{file}: format {description['format']}, not {FORMAT}; ingest the drive again")
        return description

    def _removed(self, drive_id: str) -> Path:
        return self._file(drive_id).with_suffix(".removed")

    def _existing(self, drive_id: str) -> Path:
        file = self._file(drive_id)
        if not file.is_file():
            raise NotFoundError(f"{self.folder}: no drive {drive_id}; run `presight ingest` for its data set")
        return file

    def _file(self, drive_id: str) -> Path:
        if not drive_id.isalnum():
            raise NotFoundError(f"{drive_id!r} is not a drive id; use one that `presight status` lists")
        return self.folder / f"{drive_id}.parquet"


def _damaged(file: Path, error: Exception) -> StoreError:
    fact = str(error).splitlines()[0] if str(error) else type(error).__name__
    return StoreError(f"{file}: damaged ({fact}); delete it and ingest the drive again")


def _to_arrow(frames: FrameTable) -> pa.Table:
    return pa.table({field.name: _column(field.name, getattr(frames, field.name)) for field in fields(FrameTable)})


def _column(name: str, values: NDArray) -> pa.Array:
    if name in TEXTS:
        return pa.array(values.tolist(), pa.string())
    if name in SHAPES:
        size = int(np.prod(SHAPES[name]))
        return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), size)
    return pa.array(values)


def _values(name: str, column: pa.ChunkedArray) -> NDArray:
    array = column.combine_chunks()
    if name in TEXTS:
        return np.array(array.to_pylist(), np.str_)
    if name in SHAPES:
        return np.array(array.flatten()).reshape(-1, *SHAPES[name])
    return np.array(array)  # a copy: Arrow's own memory is read-only, which torch warns about


def write_whole(table: pa.Table, file: Path) -> None:
    """Write beside the file, force it to the disk, then put it in place: a crash leaves the old Parquet or the new."""
    part = file.with_name(f".{file.stem}-{uuid4().hex}.part")
    try:
        with part.open("xb") as target:
            parquet.write_table(table, target, compression="zstd")
            target.flush()
            os.fsync(target.fileno())
        failpoint("drive-before-rename")
        part.replace(file)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    force_to_disk(file.parent)
    failpoint("drive-after-rename")
