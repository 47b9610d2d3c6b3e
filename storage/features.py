"""The feature cache: label maps and features of every image, one Zarr group a drive.

    <folder>/<key>/<drive id>/      whole or not there; `key` is the digest of the features' recipe
        features                    (N, rows, columns, C) uint8, one chunk an image
        labels_<rows>x<columns>     (N, rows, columns) uint8, one chunk an image; one array per size of label map

Rows are those of the FrameTable that was written. Every chunk carries a checksum. Rejected images have no chunk.

While a drive is written, its group is a hidden neighbour, and another one has a line an image: its row and its array
of labels, or why it was refused. Chunks of a run of images are forced to the disk before their lines are, so that
whoever finds the two after a kill goes on behind the last whole line.
"""

import fcntl
import json
import os
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import Crc32cCodec, ZstdCodec

from presight_core.drives import FrameTable, Reject
from presight_core.errors import ConflictError, InputError, NotFoundError, StoreError
from presight_core.pixels import FrameLayers
from storage.compact import CompactFeatures
from storage.folders import force_to_disk

FORMAT = 2
COMPRESSION_LEVEL = 3  # zstd's own default
RUN_IMAGES = 16  # made durable together: one wait for the disk pays for them
RUN_SECONDS = 10.0  # or fewer images, where they take long: so much work can a kill cost

Extracted = tuple[int, FrameLayers | Reject]


class FeatureCache:
    """Keeps what the feature stage made, by recipe and drive. Reading is safe from several threads."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._open: dict[tuple[str, str], _DriveLayers] = {}
        self._lock = threading.Lock()

    def is_complete(self, key: str, drive_id: str) -> bool:
        """Whether the drive's layers are there; if they are, all of them are."""
        return (self._path(key, drive_id) / "zarr.json").is_file()

    def missing_rows(self, key: str, drive_id: str, frame_count: int) -> NDArray[np.int64]:
        """Rows that neither a finished nor an interrupted write holds yet."""
        if self.is_complete(key, drive_id):
            return np.zeros(0, np.int64)
        return np.setdiff1d(np.arange(frame_count), [line["row"] for line in _lines(self._part(key, drive_id))])

    def write(
        self,
        key: str,
        drive_id: str,
        frames: FrameTable,
        items: Iterable[Extracted],
        weights: Iterable[float] | None = None,
        figures: Mapping[str, float] | None = None,
    ) -> tuple[Reject, ...]:
        """Keep an item for every missing row of `frames`, in any order, and return the drive's rejects.

        With `weights` features go through the compact code; without, they are kept exactly. `figures` are notes for
        people, looked at when all is written. If `items` raises, what came before is kept for the next write;
        layers that are complete already stay. Raises ConflictError while another process writes the same drive.
        """
        path, part = self._path(key, drive_id), self._part(key, drive_id)
        with _only_writer(part):
            if self.is_complete(key, drive_id):  # another process was faster
                part.rmdir()
                return tuple(self.rejects(key, drive_id).values())
            writer = _Writer(part, len(frames), None if weights is None else tuple(weights))
            with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
                for run in _runs(items):
                    writer.add(run, pool)
            writer.finish([str(name) for name in frames.path], figures or {})
            part.rename(path)
            force_to_disk(path.parent)
            _rows_file(part).unlink()
        return tuple(writer.rejects)

    def read(self, key: str, drive_id: str, row: int) -> FrameLayers:
        """The layers of one row. Raises InputError if its image was rejected, StoreError if the cache is damaged."""
        return self._drive(key, drive_id).read(row)

    def read_labels(self, key: str, drive_id: str, row: int) -> NDArray[np.uint8]:
        """The label map of one row; raises as `read`."""
        return self._drive(key, drive_id).read_labels(row)

    def rows_of(self, key: str, drive_id: str) -> dict[str, int]:
        """The row of every image path of the drive."""
        return self._drive(key, drive_id).rows

    def rejects(self, key: str, drive_id: str) -> dict[int, Reject]:
        """The drive's rejected rows."""
        return self._drive(key, drive_id).rejects

    def figures(self, key: str, drive_id: str) -> dict[str, float]:
        """What was noted when the drive was written, and `feature_bytes` and `label_bytes`, means of an image."""
        return self._drive(key, drive_id).figures

    def _path(self, key: str, drive_id: str) -> Path:
        return self._folder / key / drive_id

    def _part(self, key: str, drive_id: str) -> Path:
        return self._folder / key / f".{drive_id}.part"

    def _drive(self, key: str, drive_id: str) -> "_DriveLayers":
        with self._lock:
            if (key, drive_id) not in self._open:
                if not self.is_complete(key, drive_id):
                    raise NotFoundError(f"no features of drive {drive_id} under {key}; run the feature stage first")
                self._open[key, drive_id] = _DriveLayers.open(self._path(key, drive_id))
            return self._open[key, drive_id]


@contextmanager
def _only_writer(part: Path) -> Iterator[None]:
    """Make the group's folder and hold it for this process; the kernel lets go of it if the process dies."""
    part.mkdir(parents=True, exist_ok=True)
    folder = os.open(part, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    except BlockingIOError as error:
        raise ConflictError(f"{part}: another process writes these features; wait for it") from error
    finally:
        os.close(folder)


def _runs(items: Iterable[Extracted]) -> Iterator[list[Extracted]]:
    """The items in runs, also those that came before `items` raised."""
    run: list[Extracted] = []
    started = time.monotonic()
    try:
        for item in items:
            run.append(item)
            if len(run) == RUN_IMAGES or time.monotonic() - started > RUN_SECONDS:
                yield run
                run, started = [], time.monotonic()
    finally:
        if run:
            yield run


def _rows_file(part: Path) -> Path:
    return part.with_suffix(".jsonl")


def _lines(part: Path) -> list[dict[str, Any]]:
    """The lines of a group; a last line that a kill cut short does not count. Raises StoreError if one is damaged."""
    file = _rows_file(part)
    if not file.exists():
        return []
    try:
        return [json.loads(text) for text in file.read_bytes().splitlines(keepends=True) if text.endswith(b"\n")]
    except ValueError as error:
        raise _damaged(file, f"a line cannot be read ({error})") from error


class _Writer:
    """Fills one drive's group; arrays are made when the first image of their size arrives."""

    def __init__(self, part: Path, frame_count: int, weights: tuple[float, ...] | None):
        self._part, self._frame_count, self._weights = part, frame_count, weights
        whole = _lines(part)
        _rows_file(part).write_text("".join(map(_text, whole)))  # without a line that a kill cut short
        self._lines = {line["row"]: line for line in whole}
        self._group = zarr.open_group(part, mode="a", zarr_format=3)
        self._arrays: dict[str, Any] = dict(self._group.arrays())

    @property
    def rejects(self) -> list[Reject]:
        """What was refused, in the order of the rows."""
        lines = (self._lines[row] for row in sorted(self._lines))
        return [Reject(**line["reject"]) for line in lines if "reject" in line]

    def add(self, run: list[Extracted], pool: ThreadPoolExecutor) -> None:
        """Make a run of images durable."""
        run = [(row, item) for row, item in run if row not in self._lines]
        assert all(0 <= row < self._frame_count for row, _ in run), "more items than frames"
        for _, item in run:
            if isinstance(item, FrameLayers):
                self._array("features", item.features)
                self._array(_labels_name(item), item.labels)
        list(pool.map(self._store, *zip(*run, strict=True)) if run else ())
        lines = [_line(row, item) for row, item in run]
        with _rows_file(self._part).open("ab") as file:
            file.writelines(_text(line).encode() for line in lines)
        force_to_disk(_rows_file(self._part))
        self._lines |= {line["row"]: line for line in lines}

    def finish(self, paths: list[str], figures: Mapping[str, float]) -> None:
        """Write down which row is where, and which are missing."""
        done = len(self._lines)
        assert done == self._frame_count, f"{done} items for {self._frame_count} frames"
        lines = [self._lines[row] for row in range(done)]
        rejects = {str(line["row"]): line["reject"] for line in lines if "reject" in line}
        values = {"format": FORMAT, "paths": paths, "label_arrays": [line.get("labels", "") for line in lines]}
        self._group.update_attributes({**values, "rejects": rejects, "figures": {**figures, **self._sizes()}})
        for folder in [path for path in self._part.rglob("*") if path.is_dir()]:
            force_to_disk(folder)
        force_to_disk(self._part / "zarr.json")
        force_to_disk(self._part)

    def _sizes(self) -> dict[str, float]:
        """Mean bytes an image of features and of labels."""
        images = max(1, len(self._lines) - len(self.rejects))
        sizes = {"feature_bytes": 0.0, "label_bytes": 0.0}
        for name in self._arrays:
            chunks = (file for file in (self._part / name / "c").rglob("*") if file.is_file())
            total = sum(chunk.stat().st_size for chunk in chunks)
            sizes["feature_bytes" if name == "features" else "label_bytes"] += total / images
        return sizes

    def _store(self, row: int, item: FrameLayers | Reject) -> None:
        if isinstance(item, Reject):
            return
        for name, layer in (("features", item.features), (_labels_name(item), item.labels)):
            self._arrays[name][row] = layer
            force_to_disk(self._part / name / self._arrays[name].metadata.encode_chunk_key((row, *[0] * layer.ndim)))

    def _array(self, name: str, layer: NDArray[np.uint8]) -> zarr.Array:
        if name not in self._arrays:
            is_compact = name == "features" and self._weights is not None
            lossless = [] if is_compact else [ZstdCodec(level=COMPRESSION_LEVEL)]
            self._arrays[name] = self._group.create_array(
                name,
                shape=(self._frame_count, *layer.shape),
                chunks=(1, *layer.shape),
                dtype=np.uint8,
                serializer=CompactFeatures(weights=self._weights) if is_compact and self._weights else "auto",
                compressors=[*lossless, Crc32cCodec()],
                config={"write_empty_chunks": True},  # a chunk that is absent is damage, never a black image
            )
        return self._arrays[name]


def _labels_name(layers: FrameLayers) -> str:
    return f"labels_{layers.labels.shape[0]}x{layers.labels.shape[1]}"


def _text(line: dict[str, Any]) -> str:
    return json.dumps(line) + "\n"


def _line(row: int, item: FrameLayers | Reject) -> dict[str, Any]:
    if isinstance(item, Reject):
        return {"row": int(row), "reject": asdict(item)}
    return {"row": int(row), "labels": _labels_name(item)}


@dataclass(frozen=True)
class _DriveLayers:
    """One drive's group, open for reading."""

    path: Path
    arrays: dict[str, Any]
    label_arrays: list[str]
    rows: dict[str, int]
    rejects: dict[int, Reject]
    figures: dict[str, float]

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
                figures=values["figures"],
            )
        except (ValueError, KeyError, TypeError, OSError) as error:
            raise _damaged(path, f"its documents cannot be read ({error})") from error
        layers._check(values.get("format"))
        return layers

    def read(self, row: int) -> FrameLayers:
        """The layers of one row."""
        return FrameLayers(self.read_labels(row), self._chunk("features", row))

    def read_labels(self, row: int) -> NDArray[np.uint8]:
        """The label map of one row."""
        if row in self.rejects:
            reject = self.rejects[row]
            raise InputError(f"{reject.file}: {reject.detail}; {reject.cure}")
        return self._chunk(self.label_arrays[row], row)

    def _chunk(self, name: str, row: int) -> NDArray[np.uint8]:
        try:
            return self.arrays[name][row]
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
    return StoreError(f"{path}: {fact}; delete this, and the next build makes it again")
