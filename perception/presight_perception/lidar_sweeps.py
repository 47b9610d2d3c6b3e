"""Which lidar sweeps the drives of a data set in the nuScenes format have, and where the vehicle was."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from presight_core import frames
from presight_core.errors import InputError
from presight_core.table import read_table

CHANNEL = "LIDAR_TOP"
POINT_VALUES = 5  # float32 each: x, y, z in metres, intensity, ring

Quaternion = tuple[float, float, float, float]  # w, x, y, z
Vector = tuple[float, float, float]
Row = TypeVar("Row", bound=msgspec.Struct)


@dataclass(frozen=True)
class Sweep:
    """One turn of the lidar, at a keyframe."""

    drive: str  # the scene's name
    city: str
    file: Path
    ego_from_lidar: NDArray[np.float64]  # (4, 4) metres
    world_from_ego: NDArray[np.float64]  # (4, 4) metres, at the lidar's time

    def points_ego(self) -> NDArray[np.float64]:
        """The finite returns (N, 3), ego metres. Raises InputError for a file that is missing or cut short."""
        try:
            content = self.file.read_bytes()
        except OSError as error:
            raise InputError(f"{self.file}: {error.strerror}; extract the data set's lidar archive there") from error
        point_bytes = 4 * POINT_VALUES
        if len(content) % point_bytes:
            fact = f"{len(content)} bytes are no whole number of points of {point_bytes} bytes"
            raise InputError(f"{self.file}: {fact}; copy it again")
        points_lidar = np.frombuffer(content, "<f4").reshape(-1, POINT_VALUES)[:, :3]
        return frames.apply(self.ego_from_lidar, points_lidar[np.isfinite(points_lidar).all(-1)])


class _Log(msgspec.Struct):
    token: str
    location: str


class _Scene(msgspec.Struct):
    token: str
    log_token: str
    name: str


class _Sample(msgspec.Struct):
    token: str
    scene_token: str


class _Sensor(msgspec.Struct):
    token: str
    channel: str


class _Mounted(msgspec.Struct):
    """A sensor in a log, or the vehicle at a moment."""

    token: str
    translation: Vector
    rotation: Quaternion

    @property
    def transform(self) -> NDArray[np.float64]:
        return frames.transform(frames.rotation_from_quaternion(self.rotation), self.translation)


class _Calibration(_Mounted):
    sensor_token: str


class _File(msgspec.Struct, gc=False):
    sample_token: str
    ego_pose_token: str
    calibrated_sensor_token: str
    is_key_frame: bool
    filename: str


def read_sweeps(root: Path, version: str, drives: Collection[str]) -> list[Sweep]:
    """The keyframe sweeps of the drives (scene names), in the order of the table `root / version / sample_data.json`.

    Raises InputError for a missing or damaged table, rows that name each other in vain, and a drive that is not
    there or has no sweep.
    """
    folder = root / version
    logs, scenes = _by_token(folder, "log", _Log), _by_token(folder, "scene", _Scene)
    wanted = {token: scene for token, scene in scenes.items() if scene.name in set(drives)}
    samples = _by_token(folder, "sample", _Sample)
    scene_of_sample = {row.token: wanted[row.scene_token] for row in samples.values() if row.scene_token in wanted}
    sensors, mounted = _by_token(folder, "sensor", _Sensor), _by_token(folder, "calibrated_sensor", _Calibration)
    lidars = {row.token for row in mounted.values() if sensors[row.sensor_token].channel == CHANNEL}
    files = [
        row
        for rows in read_table(folder / "sample_data.json", _File)
        for row in rows
        if row.is_key_frame and row.calibrated_sensor_token in lidars and row.sample_token in scene_of_sample
    ]
    missing = sorted(set(drives) - {scene_of_sample[row.sample_token].name for row in files})
    if missing:
        raise InputError(f"{folder}: no {CHANNEL} keyframes of {', '.join(missing)}; choose drives that have them")
    poses = _by_token(folder, "ego_pose", _Mounted, {row.ego_pose_token for row in files})
    sweeps = []
    for row in files:
        scene = scene_of_sample[row.sample_token]
        ego_from_lidar = mounted[row.calibrated_sensor_token].transform
        world_from_ego = poses[row.ego_pose_token].transform
        city = logs[scene.log_token].location
        sweeps.append(Sweep(scene.name, city, root / row.filename, ego_from_lidar, world_from_ego))
    return sweeps


class _Rows(dict[str, Row]):
    """Rows of a table by token."""

    def __init__(self, file: Path, rows: dict[str, Row]) -> None:
        super().__init__(rows)
        self.file = file

    def __missing__(self, token: str) -> Row:
        raise InputError(
            f"{self.file}: no row has the token {token!r} that another table names; copy both tables again"
        )


def _by_token(folder: Path, table: str, row_type: type[Row], tokens: Collection[str] | None = None) -> _Rows[Row]:
    """All rows of a table, or those of the given tokens."""
    file = folder / f"{table}.json"
    rows = (row for block in read_table(file, row_type) for row in block)
    named = ((row.token, row) for row in rows)  # type: ignore[attr-defined]
    return _Rows(file, {token: row for token, row in named if tokens is None or token in tokens})
