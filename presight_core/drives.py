"""Drives and their frames: what ingest produces and every later stage reads."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from presight_core.cameras import Camera


@dataclass(frozen=True)
class Drive:
    """One nuScenes scene: immutable, named by the digest of its content."""

    drive_id: str  # head of the SHA-256 over the city and the frames' poses, intrinsics, times, paths and sizes
    name: str  # scene name, "scene-0061"
    city: str  # log location, "singapore-onenorth"
    root: str  # dataset root: a folder or URL that frame paths are relative to
    version: str  # table folder, "v1.0-trainval"
    captured: str  # date of the log, "2018-07-24"
    frame_count: int
    start_us: int
    end_us: int


@dataclass(frozen=True)
class Reject:
    """One thing that ingest or a later stage refused, and why."""

    code: str  # short and stable, "image-missing"
    file: str  # the file at fault
    detail: str  # the fact, with its values
    cure: str  # what the user can do
    drive: str = ""  # scene name, when it is known


@dataclass(frozen=True)
class FrameTable:
    """Camera images, a row each, ordered by drive, camera and time.

    `world_from_camera` is built from the ego pose of the image's own timestamp.
    """

    drive_id: NDArray[np.str_]  # (N,)
    camera: NDArray[np.str_]  # (N,) channel, "CAM_FRONT"
    timestamp_us: NDArray[np.int64]  # (N,)
    path: NDArray[np.str_]  # (N,) relative to the drive's root
    file_bytes: NDArray[np.int64]  # (N,) size of the image file
    width_px: NDArray[np.int32]  # (N,)
    height_px: NDArray[np.int32]  # (N,)
    intrinsics: NDArray[np.float64]  # (N, 3, 3) pixels
    world_from_camera: NDArray[np.float64]  # (N, 4, 4) metres
    is_keyframe: NDArray[np.bool_]  # (N,)

    def __len__(self) -> int:
        return len(self.timestamp_us)

    def select(self, rows: NDArray) -> "FrameTable":
        """The given rows: a boolean mask or an index array."""
        return replace(self, **{field.name: getattr(self, field.name)[rows] for field in fields(self)})

    def camera_of(self, row: int) -> Camera:
        """The camera of one row."""
        size = int(self.width_px[row]), int(self.height_px[row])
        return Camera(self.intrinsics[row], self.world_from_camera[row], *size)

    @property
    def positions(self) -> NDArray[np.float64]:
        """Camera centres (N, 3), world metres."""
        return self.world_from_camera[:, :3, 3]

    @staticmethod
    def concatenate(tables: Sequence["FrameTable"]) -> "FrameTable":
        """One table of all rows, in the given order; at least one table."""
        columns = {
            field.name: np.concatenate([getattr(table, field.name) for table in tables]) for field in fields(FrameTable)
        }
        return FrameTable(**columns)
