"""Keyframe files of a data set in the nuScenes format: which sensor made them, where, and on which drive."""

from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from presight_core import frames
from presight_core.errors import InputError
from presight_core.table import read_table

Quaternion = tuple[float, float, float, float]  # w, x, y, z
Vector = tuple[float, float, float]


class LogRow(msgspec.Struct):
    """One drive of a vehicle, of several scenes."""

    token: str
    location: str


class SceneRow(msgspec.Struct):
    """Twenty seconds of a log."""

    token: str
    log_token: str
    name: str
    description: str = ""


class SampleRow(msgspec.Struct):
    """A keyframe of all sensors."""

    token: str
    scene_token: str
    timestamp: int


class SensorRow(msgspec.Struct):
    """A sensor's name."""

    token: str
    channel: str


class PoseRow(msgspec.Struct, gc=False):
    """The vehicle at a moment: `world_from_ego`."""

    token: str
    translation: Vector
    rotation: Quaternion

    @property
    def transform(self) -> NDArray[np.float64]:
        """A transform (4, 4), metres."""
        return frames.transform(frames.rotation_from_quaternion(self.rotation), self.translation)


class CalibrationRow(PoseRow):
    """A sensor as mounted in one log: `ego_from_sensor`."""

    sensor_token: str
    camera_intrinsic: list[list[float]] = []


class FileRow(msgspec.Struct, gc=False):
    """One file of one sensor."""

    sample_token: str
    ego_pose_token: str
    calibrated_sensor_token: str
    is_key_frame: bool
    filename: str
    width: int = 0  # of images
    height: int = 0


Row = TypeVar("Row")


class Rows(dict[str, Row]):
    """Rows of a table by token; a token that is not there is an InputError that names the table."""

    def __init__(self, file: Path, rows: dict[str, Row]) -> None:
        super().__init__(rows)
        self.file = file

    def __missing__(self, token: str) -> Row:
        raise InputError(
            f"{self.file}: no row has the token {token!r} that another table names; copy both tables again"
        )


class NuscenesTables:
    """The tables of one version, joined by token. Raises InputError for those that are missing or damaged."""

    def __init__(self, root: Path, version: str) -> None:
        self.root, self.folder = Path(root), Path(root) / version
        self.logs, self.scenes = self._by_token("log", LogRow), self._by_token("scene", SceneRow)
        self.samples, self.sensors = self._by_token("sample", SampleRow), self._by_token("sensor", SensorRow)
        self.calibrations = self._by_token("calibrated_sensor", CalibrationRow)

    def scene_of(self, sample_token: str) -> SceneRow:
        """The scene of a sample."""
        return self.scenes[self.samples[sample_token].scene_token]

    def city_of(self, scene: SceneRow) -> str:
        """Where a scene was recorded."""
        return self.logs[scene.log_token].location

    def keyframe_files(self) -> dict[str, dict[str, FileRow]]:
        """The keyframe files of every sample, by the sample's token and the sensor's channel."""
        files: dict[str, dict[str, FileRow]] = {}
        for block in read_table(self.folder / "sample_data.json", FileRow):
            for row in (row for row in block if row.is_key_frame):
                calibration = self.calibrations[row.calibrated_sensor_token]
                files.setdefault(row.sample_token, {})[self.sensors[calibration.sensor_token].channel] = row
        return files

    def poses(self, files: Iterable[FileRow]) -> Rows[PoseRow]:
        """Where the vehicle was when these files were made."""
        return self._by_token("ego_pose", PoseRow, {row.ego_pose_token for row in files})

    def _by_token(self, table: str, row_type: type[Any], tokens: Collection[str] | None = None) -> Rows[Any]:
        """All rows of a table, or those of the given tokens."""
        file = self.folder / f"{table}.json"
        rows = (row for block in read_table(file, row_type) for row in block)
        return Rows(file, {row.token: row for row in rows if tokens is None or row.token in tokens})
