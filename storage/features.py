"""The feature cache: label maps and features of every image, one Zarr group a drive.

    <folder>/<key>/<drive id>/      written once, whole or not at all; `key` is the digest of the features' recipe
        features                    (N, rows, columns, C) uint8, one chunk an image
        labels_<rows>x<columns>     (N, rows, columns) uint8, one chunk an image; one array per size of label map

Rows are those of the FrameTable that was written. Every chunk carries a checksum. Rejected images have no chunk;
their rows are in the group's attributes.
"""

import threading
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import Crc32cCodec, ZstdCodec

from presight_core.drives import FrameTable, Reject
from presight_core.errors import InputError, NotFoundError, StoreError
from presight_core.pixels import FrameLayers
from storage.folders import whole_folder

FORMAT = 1
COMPRESSION_LEVEL = 3  # zstd's own default

Extracted = tuple[int, FrameLayers] | Reject


class FeatureCache:
    """Keeps what the feature stage made, by recipe and drive. Reading is safe from several threads."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._open: dict[tuple[str, str], _DriveLayers] = {}
        self._lock = threading.Lock()

    def is_complete(self, key: str, drive_id: str) -> bool:
        """Whether the drive's layers are there; if they are, all of them are."""
        return (self._path(key, drive_id) / "zarr.json").is_file()

    def write(self, key: str, drive_id: str, frames: FrameTable, items: Iterable[Extracted]) -> tuple[Reject, ...]:
        """Keep one item a row of `frames`, in order, and return the rejects among them.

        Nothing is left behind if `items` raises; layers that are there already are kept.
        """
        with whole_folder(self._path(key, drive_id)) as temporary:
            writer = _Writer(zarr.create_group(temporary, zarr_format=3), len(frames))
            for row, item in enumerate(items):
                writer.add(row, item)
            writer.finish([str(path) for path in frames.path])
        return tuple(writer.rejects.values())

    def read(self, key: str, drive_id: str, row: int) -> FrameLayers:
        """The layers of one row. Raises InputError if its image was rejected, StoreError if the cache is damaged."""
        return self._drive(key, drive_id).read(row)

    def rows_of(self, key: str, drive_id: str) -> dict[str, int]:
        """The row of every image path of the drive."""
        return self._drive(key, drive_id).rows

    def rejects(self, key: str, drive_id: str) -> dict[int, Reject]:
        """The drive's rejected rows."""
        return self._drive(key, drive_id).rejects

    def _path(self, key: str, drive_id: str) -> Path:
        return self._folder / key / drive_id

    def _drive(self, key: str, drive_id: str) -> "_DriveLayers":
        with self._lock:
            if (key, drive_id) not in self._open:
                if not self.is_complete(key, drive_id):
                    raise NotFoundError(f"no features of drive {drive_id} under {key}; run the feature stage first")
                self._open[key, drive_id] = _DriveLayers.open(self._path(key, drive_id))
            return self._open[key, drive_id]


class _Writer:
    """Fills one drive's group; arrays are made when the first image of their size arrives."""

    def __init__(self, group: zarr.Group, frame_count: int):
        self.rejects: dict[int, Reject] = {}
        self._group, self._frame_count, self._label_arrays = group, frame_count, [""] * frame_count
        self._arrays: dict[str, zarr.Array] = {}

    def add(self, row: int, item: Extracted) -> None:
        """Store the next row."""
        assert row < self._frame_count, "more items than frames"
        if isinstance(item, Reject):
            self.rejects[row] = item
            return
        assert item[0] == row, f"row {item[0]} came where {row} was due"
        labels, features = item[1].labels, item[1].features
        self._label_arrays[row] = f"labels_{labels.shape[0]}x{labels.shape[1]}"
        self._array(self._label_arrays[row], labels)[row] = labels
        self._array("features", features)[row] = features

    def finish(self, paths: list[str]) -> None:
        """Write down which row is where, and which are missing."""
        done = len(self.rejects) + sum(map(bool, self._label_arrays))
        assert done == self._frame_count, f"{done} items for {self._frame_count} frames"
        rejects = {str(row): asdict(reject) for row, reject in self.rejects.items()}
        values = {"format": FORMAT, "paths": paths, "label_arrays": self._label_arrays, "rejects": rejects}
        self._group.update_attributes(values)

    def _array(self, name: str, layer: NDArray[np.uint8]) -> zarr.Array:
        if name not in self._arrays:
            self._arrays[name] = self._group.create_array(
                name,
                shape=(self._frame_count, *layer.shape),
                chunks=(1, *layer.shape),
                dtype=np.uint8,
                compressors=[ZstdCodec(level=COMPRESSION_LEVEL), Crc32cCodec()],
                config={"write_empty_chunks": True},  # a chunk that is absent is damage, never a black image
            )
        return self._arrays[name]


@dataclass(frozen=True)
class _DriveLayers:
    """One drive's group, open for reading."""

    path: Path
    arrays: dict[str, Any]
    label_arrays: list[str]
    rows: dict[str, int]
    rejects: dict[int, Reject]

    @staticmethod
    def open(path: Path) -> "_DriveLayers":
        """Raises StoreError if the group is of another format, or if chunks are missing."""
        try:
            group = zarr.open_group(path, mode="r")
            values: dict[str, Any] = dict(group.attrs)
            layers = _DriveLayers(
                path=path,
                arrays=dict(group.arrays()),
                label_arrays=values["label_arrays"],
                rows={image: row for row, image in enumerate(values["paths"])},
                rejects={int(row): Reject(**reject) for row, reject in values["rejects"].items()},
            )
        except (ValueError, KeyError, TypeError, OSError) as error:
            raise _damaged(path, f"its documents cannot be read ({error})") from error
        layers._check(values.get("format"))
        return layers

    def read(self, row: int) -> FrameLayers:
        """The layers of one row."""
        if row in self.rejects:
            reject = self.rejects[row]
            raise InputError(f"{reject.file}: {reject.detail}; {reject.cure}")
        try:
            return FrameLayers(self.arrays[self.label_arrays[row]][row], self.arrays["features"][row])
        except (ValueError, RuntimeError, OSError) as error:  # a wrong checksum, a frame zstd refuses, a bad disk
            raise _damaged(self.path, f"row {row} cannot be read ({error})") from error

    def _check(self, version: object) -> None:
        if version != FORMAT:
            raise _damaged(self.path, f"format {version}, this program reads {FORMAT}")
        present = len(self.rows) - len(self.rejects)
        for names in ({"features"}, self.arrays.keys() - {"features"}):
            found = sum(self.arrays[name].nchunks_initialized for name in names if name in self.arrays)
            if found != present:
                raise _damaged(self.path, f"{found} chunks of {', '.join(sorted(names))}, expected {present}")


def _damaged(path: Path, fact: str) -> StoreError:
    return StoreError(f"{path}: {fact}; delete this folder, and the next build makes it again")
