"""Ingest: a data set in the nuScenes v1.0 format becomes drives of checked camera frames.

The tables are read and joined as a whole before the first drive is given out. After that a fault costs one frame,
never its drive: the frame becomes a Reject.
"""

import hashlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from presight_core import frames
from presight_core.drives import Drive, FrameTable, Reject
from presight_core.errors import InputError
from presight_core.progress import Progress, Report, silent
from presight_core.recipes import DIGEST_LENGTH
from stages.frame_faults import Faults, find_faults
from stages.image_folder import ExpectedImage, ImageFolder, printable
from stages.image_header import ImageFault
from stages.nuscenes import Dataset, read_dataset
from stages.scene_choice import SceneChoice

LISTED_REJECTS = 20  # of one kind in one drive; the others are counted: a whole archive may be missing
DIGEST_FORMAT = b"presight-drive-1"  # raise the number when what the digest covers changes


@dataclass(frozen=True)
class IngestedDrive:
    """A drive with its good frames, and what was refused of it; where nothing is good the table is empty."""

    drive: Drive
    frames: FrameTable
    rejects: tuple[Reject, ...]


def ingest_nuscenes(
    root: Path,
    version: str,
    report: Report = silent,
    images: Literal["check", "trust"] = "check",
    choice: SceneChoice | None = None,
) -> Iterator[IngestedDrive]:
    """The drives of a nuScenes-format data set, one a scene, in the order of its scene table.

    Every camera image is a frame, sweeps too, with the ego pose of its own timestamp. Image files are opened to
    compare their size with the table's and to see their end; `images="trust"` opens none (then `file_bytes` is 0).
    `choice` takes some of the scenes only. Raises InputError, before the first drive, where it takes none, and
    where the root or its tables are unusable (see `read_dataset`).
    """
    root = Path(root)
    dataset = read_dataset(root, version, report)
    ingest = _Ingest(root.resolve(), version, dataset, find_faults(dataset))
    return ingest.drives(_chosen(dataset, choice or SceneChoice()), images == "check", report)


def _chosen(dataset: Dataset, choice: SceneChoice) -> list[int]:
    """Rows of the scenes to ingest."""
    chosen = [row for row, scene in enumerate(dataset.scenes) if choice.takes(scene)]
    if not chosen:
        names = sorted(scene.name for scene in dataset.scenes)
        raise InputError(
            f"{dataset.folder}/scene.json: no scene {choice}; "
            f"its {len(names)} scenes are {names[0]} to {names[-1]}: choose among them"
        )
    return chosen


@dataclass(frozen=True)
class _Ingest:
    """Tables and their faults, on the way to drives."""

    root: Path
    version: str
    dataset: Dataset
    faults: Faults

    def drives(self, scenes: list[int], check_images: bool, report: Report) -> Iterator[IngestedDrive]:
        scene_of_image = self.dataset.images.scene
        by_scene = np.argsort(scene_of_image, kind="stable")
        bounds = np.searchsorted(scene_of_image[by_scene], np.arange(len(self.dataset.scenes) + 1))
        kept = seen = 0
        with ImageFolder(self.root) as folder:
            for number, scene in enumerate(scenes, 1):
                rows = by_scene[bounds[scene] : bounds[scene + 1]]
                ingested = self._drive(scene, rows, folder if check_images else None)
                kept, seen = kept + len(ingested.frames), seen + len(rows)
                figures = {"frames": float(kept), "rejected": float(seen - kept)}
                report(Progress("ingest", number, len(scenes), figures))
                yield ingested

    def _drive(self, scene: int, rows: NDArray[np.int64], folder: ImageFolder | None) -> IngestedDrive:
        is_faulty = self.faults.first[rows] >= 0
        rejects = [self.faults.reject(int(row)) for row in rows[is_faulty]]
        rows = self._ordered(rows[~is_faulty])
        file_bytes = np.zeros(len(rows), np.int64)
        if folder is not None:
            file_bytes, image_rejects = self._check_images(rows, folder)
            rows, file_bytes = rows[file_bytes >= 0], file_bytes[file_bytes >= 0]
            rejects += image_rejects
        if not len(rows) and not rejects:
            rejects = [self._empty(scene)]
        drive_id = self._drive_id(scene, rows, file_bytes)
        name = self.dataset.scenes[scene].name
        table = self._frames(drive_id, rows, file_bytes)
        return IngestedDrive(self._describe(scene, drive_id, table), table, _abridged(rejects, name))

    def _ordered(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """The rows by camera, then time."""
        images = self.dataset.images
        camera = self.dataset.calibrations.channel[images.calibration[rows]]
        return rows[np.lexsort((images.timestamp_us[rows], camera))]

    def _check_images(self, rows: NDArray[np.int64], folder: ImageFolder) -> tuple[NDArray[np.int64], list[Reject]]:
        """File size of every row's image, -1 where it is refused, and the rejects."""
        images = self.dataset.images
        columns = images.path[rows], images.width_px[rows].tolist(), images.height_px[rows].tolist()
        results = folder.check_all([ExpectedImage(*row) for row in zip(*columns, strict=True)])
        file_bytes = np.array([-1 if isinstance(result, ImageFault) else result for result in results], np.int64)
        rejects = [
            Reject(result.code, f"{self.root}/{printable(path)}", result.detail, result.cure)
            for path, result in zip(columns[0], results, strict=True)
            if isinstance(result, ImageFault)
        ]
        return file_bytes, rejects

    def _empty(self, scene: int) -> Reject:
        name = self.dataset.scenes[scene].name
        file = str(self.dataset.folder / "sample_data.json")
        return Reject("drive-empty", file, f"no camera image of {name}", "add its rows, or remove the scene")

    def _drive_id(self, scene: int, rows: NDArray[np.int64], file_bytes: NDArray[np.int64]) -> str:
        """Digest of the city and of everything a frame is made of, as the tables have it.

        Poses enter as quaternions and translations: their product differs in the last bit from machine to machine.
        """
        images, poses, cameras = self.dataset.images, self.dataset.poses, self.dataset.calibrations
        pose, calibration = images.pose[rows], images.calibration[rows]
        texts = [self.dataset.scenes[scene].city, *cameras.channel[calibration], *images.path[rows]]
        if not len(rows):
            texts.append(self.dataset.scenes[scene].name)  # else all drives without frames would be one
        columns = [
            images.timestamp_us[rows], file_bytes, images.width_px[rows], images.height_px[rows],
            images.is_keyframe[rows], poses.rotation_wxyz[pose], poses.translation_m[pose],
            cameras.rotation_wxyz[calibration], cameras.translation_m[calibration], cameras.intrinsics[calibration],
        ]  # fmt: skip
        digest = hashlib.sha256(DIGEST_FORMAT)
        digest.update("\n".join(texts).encode(errors="surrogatepass"))
        for column in columns:
            little_endian = column.dtype.newbyteorder("<")
            digest.update(np.ascontiguousarray(column, little_endian).tobytes())
        return digest.hexdigest()[:DIGEST_LENGTH]

    def _frames(self, drive_id: str, rows: NDArray[np.int64], file_bytes: NDArray[np.int64]) -> FrameTable:
        images, poses, cameras = self.dataset.images, self.dataset.poses, self.dataset.calibrations
        pose, calibration = images.pose[rows], images.calibration[rows]
        world_from_ego = _transform(poses.rotation_wxyz[pose], poses.translation_m[pose])
        ego_from_camera = _transform(cameras.rotation_wxyz[calibration], cameras.translation_m[calibration])
        return FrameTable(
            drive_id=np.full(len(rows), drive_id),
            camera=cameras.channel[calibration],
            timestamp_us=images.timestamp_us[rows],
            path=images.path[rows].astype(np.str_),
            file_bytes=file_bytes,
            width_px=images.width_px[rows],
            height_px=images.height_px[rows],
            intrinsics=cameras.intrinsics[calibration],
            world_from_camera=world_from_ego @ ego_from_camera,
            is_keyframe=images.is_keyframe[rows],
        )

    def _describe(self, scene: int, drive_id: str, table: FrameTable) -> Drive:
        times = table.timestamp_us if len(table) else np.zeros(1, np.int64)
        record = self.dataset.scenes[scene]
        return Drive(
            drive_id=drive_id,
            name=record.name,
            city=record.city,
            root=str(self.root),
            version=self.version,
            captured=record.captured,
            frame_count=len(table),
            start_us=int(times.min()),
            end_us=int(times.max()),
        )


def _transform(rotation_wxyz: NDArray[np.float64], translation_m: NDArray[np.float64]) -> NDArray[np.float64]:
    return frames.transform(frames.rotation_from_quaternion(rotation_wxyz), translation_m)


def _abridged(rejects: Sequence[Reject], name: str) -> tuple[Reject, ...]:
    """The rejects with the drive's name; beyond the first of a kind, one that counts the rest."""
    kept: list[Reject] = []
    counts: Counter[str] = Counter()
    for reject in rejects:
        counts[reject.code] += 1
        if counts[reject.code] <= LISTED_REJECTS:
            kept.append(replace(reject, drive=name))
        elif counts[reject.code] == LISTED_REJECTS + 1:
            rest = sum(other.code == reject.code for other in rejects) - LISTED_REJECTS
            kept.append(replace(reject, drive=name, detail=f"{reject.detail} (and {rest - 1} more frames like it)"))
    return tuple(kept)
