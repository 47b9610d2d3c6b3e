"""The nuScenes v1.0 tables, read and joined: which image was taken when, by which camera, from which pose.

Everything that makes the tables as a whole unusable is an InputError here. What concerns one image only (a NaN
pose, a missing file) passes; `stages.ingest` rejects that image.
"""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import Annotated, Any, Protocol, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from presight_core.errors import InputError
from presight_core.progress import Report, silent
from presight_core.table import CURE, read_table

TABLES = ("log", "scene", "sample", "sample_data", "ego_pose", "calibrated_sensor", "sensor")
PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")  # a city or camera names folders of the store

Token = Annotated[str, msgspec.Meta(min_length=1, max_length=128)]  # real ones have 32 hex digits
Whole = Annotated[int, msgspec.Meta(ge=-(2**62), le=2**62)]  # fits int64
Pixels = Annotated[int, msgspec.Meta(ge=0, le=2**31 - 1)]  # fits int32; 0 for lidar and radar
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # w, x, y, z


class LogRow(msgspec.Struct):
    """One drive of a vehicle, of several scenes."""

    token: Token
    location: str
    date_captured: str = ""


class SceneRow(msgspec.Struct):
    """Twenty seconds of a log."""

    token: Token
    log_token: Token
    name: str
    first_sample_token: str
    description: str = ""


class SampleRow(msgspec.Struct):
    """A keyframe of all sensors; sweeps name the keyframe they belong to."""

    token: Token
    scene_token: Token
    next: str | None = None


class SensorRow(msgspec.Struct):
    """A sensor of the vehicle."""

    token: Token
    channel: str
    modality: str


class CalibrationRow(msgspec.Struct):
    """A sensor as mounted in one log: `ego_from_camera` and intrinsics."""

    token: Token
    sensor_token: Token
    translation: Vector
    rotation: Quaternion
    camera_intrinsic: list[list[float]] = []


class PoseRow(msgspec.Struct, gc=False):
    """`world_from_ego` at one moment."""

    token: Token
    timestamp: Whole
    translation: Vector
    rotation: Quaternion


class ImageRow(msgspec.Struct, gc=False):
    """One file of one sensor."""

    token: Token
    sample_token: Token
    ego_pose_token: Token
    calibrated_sensor_token: Token
    timestamp: Whole
    is_key_frame: bool
    width: Pixels
    height: Pixels
    filename: Annotated[str, msgspec.Meta(max_length=4096)]  # the longest path that Linux opens


@dataclass(frozen=True)
class Scene:
    """One scene and its log."""

    name: str
    city: str
    captured: str  # date, "2018-07-24"
    description: str = ""  # free text; nights say so here


@dataclass(frozen=True)
class Calibrations:
    """Sensors as mounted, a row each: `ego_from_camera` in metres, intrinsics in pixels."""

    channel: NDArray[np.str_]  # (K,)
    is_camera: NDArray[np.bool_]  # (K,)
    rotation_wxyz: NDArray[np.float64]  # (K, 4)
    translation_m: NDArray[np.float64]  # (K, 3)
    intrinsics: NDArray[np.float64]  # (K, 3, 3); NaN where the table's matrix has another shape


@dataclass(frozen=True)
class Poses:
    """`world_from_ego` at the moments of the images, a row each, metres."""

    timestamp_us: NDArray[np.int64]  # (P,)
    rotation_wxyz: NDArray[np.float64]  # (P, 4)
    translation_m: NDArray[np.float64]  # (P, 3)


@dataclass(frozen=True)
class Images:
    """Camera images, a row each, in the order of the table."""

    scene: NDArray[np.int32]  # (N,) row of the scenes
    calibration: NDArray[np.int32]  # (N,) row of Calibrations
    pose: NDArray[np.int32]  # (N,) row of Poses
    timestamp_us: NDArray[np.int64]  # (N,)
    width_px: NDArray[np.int32]  # (N,)
    height_px: NDArray[np.int32]  # (N,)
    is_keyframe: NDArray[np.bool_]  # (N,)
    path: NDArray[np.object_]  # (N,) str, as the table has it: may point anywhere


@dataclass(frozen=True)
class Dataset:
    """The camera side of one set of tables."""

    folder: Path  # of the tables
    scenes: tuple[Scene, ...]
    calibrations: Calibrations
    poses: Poses
    images: Images


def read_dataset(root: Path, version: str, report: Report = silent) -> Dataset:
    """The cameras' part of the tables in `root / version`.

    Raises InputError, naming file and cure, for a missing root, version or table, a damaged table, a token that
    appears twice or leads nowhere, keyframes linked in a circle, and names that cannot name a city or a camera.
    """
    folder = _table_folder(root, version)
    logs, scenes = _read(folder, "log", LogRow), _read(folder, "scene", SceneRow)
    samples = _read(folder, "sample", SampleRow)
    scene_of_sample = _scene_of_sample(folder, scenes, samples)
    sensors, calibrations = _read(folder, "sensor", SensorRow), _read(folder, "calibrated_sensor", CalibrationRow)
    cameras = _calibrations(folder, sensors, calibrations)
    reader = _ImageReader(folder, scene_of_sample, _rows_by_token(folder, "calibrated_sensor", calibrations), cameras)
    images = reader.read(report)
    poses = _read_poses(folder, reader.pose_rows, images, report)
    return Dataset(folder, _scenes(folder, logs, scenes), cameras, poses, images)


def _table_folder(root: Path, version: str) -> Path:
    if not root.is_dir():
        raise InputError(f"{root}: no such folder; give the folder that holds samples/, sweeps/ and {version}/")
    present = sorted(file.parent.name for file in root.glob("*/sample_data.json"))
    folder = root / version
    if not PLAIN_NAME.fullmatch(version) or not folder.is_dir():
        cure = f"choose one of: {', '.join(present)}" if present else "extract the data set's metadata archive there"
        raise InputError(f"{root}: no tables of version {version!r}; {cure}")
    for table in TABLES:
        if not (folder / f"{table}.json").is_file():
            raise InputError(f"{folder / table}.json: missing; {CURE}")
    return folder


class _HasToken(Protocol):
    token: str


TokenRow = TypeVar("TokenRow", bound=msgspec.Struct)


def _read(folder: Path, table: str, row_type: type[TokenRow]) -> list[TokenRow]:
    """All rows of a small table; at least one."""
    rows = [row for block in read_table(folder / f"{table}.json", row_type) for row in block]
    if not rows:
        raise InputError(f"{folder / table}.json: no rows; {CURE}")
    return rows


def _rows_by_token(folder: Path, table: str, rows: Sequence[Any]) -> dict[str, int]:
    """Row numbers by token."""
    by_token = {row.token: number for number, row in enumerate(rows)}
    if len(by_token) < len(rows):
        twice = next(row.token for number, row in enumerate(rows) if by_token[row.token] != number)
        raise _duplicate(folder, table, twice)
    return by_token


def _duplicate(folder: Path, table: str, token: str) -> InputError:
    return InputError(f"{folder / table}.json: token {token!r} appears twice; remove one of the rows, or {CURE}")


def _dangling(folder: Path, table: str, field: str, token: str, target: str) -> InputError:
    fact = f"{field} {token!r} is not in {target}.json"
    return InputError(f"{folder / table}.json: {fact}; take both tables from the same archive")


def _scenes(folder: Path, logs: list[LogRow], rows: list[SceneRow]) -> tuple[Scene, ...]:
    log_rows = _rows_by_token(folder, "log", logs)
    scenes = {}
    for row in rows:
        if row.log_token not in log_rows:
            raise _dangling(folder, "scene", "log_token", row.log_token, "log")
        log = logs[log_rows[row.log_token]]
        _require_plain(folder / "log.json", "location", log.location)
        _require_plain(folder / "scene.json", "name", row.name)
        if row.name in scenes:
            raise InputError(f"{folder}/scene.json: two scenes are named {row.name}; rename one")
        scenes[row.name] = Scene(row.name, log.location, log.date_captured, row.description)
    return tuple(scenes.values())


def _require_plain(file: Path, field: str, name: str) -> None:
    if not PLAIN_NAME.fullmatch(name):
        rule = "use at most 64 letters, digits, '.', '_' and '-', a letter or digit first"
        raise InputError(f"{file}: {field} {name[:80]!r} cannot be a name; {rule}")


def _scene_of_sample(folder: Path, scenes: list[SceneRow], samples: list[SampleRow]) -> dict[str, int]:
    """The scene's row of every sample, by the sample's token; the keyframes' links are followed once."""
    scene_rows = _rows_by_token(folder, "scene", scenes)
    sample_rows = _rows_by_token(folder, "sample", samples)
    for sample in samples:
        if sample.scene_token not in scene_rows:
            raise _dangling(folder, "sample", "scene_token", sample.scene_token, "scene")
    visited: set[str] = set()
    for scene in scenes:
        _follow(folder, scene, samples, sample_rows, visited)
    return {sample.token: scene_rows[sample.scene_token] for sample in samples}


def _follow(
    folder: Path, scene: SceneRow, samples: list[SampleRow], sample_rows: dict[str, int], visited: set[str]
) -> None:
    """Walk a scene's keyframes from the first to the last, marking them as `visited`."""
    table, field, token = "scene", "first_sample_token", scene.first_sample_token
    while token:
        if token not in sample_rows:
            raise _dangling(folder, table, field, token, "sample")
        if token in visited:
            raise InputError(f"{folder / table}.json: {field} {token!r} leads back to a keyframe already seen; {CURE}")
        visited.add(token)
        table, field, token = "sample", "next", samples[sample_rows[token]].next


def _calibrations(folder: Path, sensors: list[SensorRow], rows: list[CalibrationRow]) -> Calibrations:
    sensor_rows = _rows_by_token(folder, "sensor", sensors)
    for row in rows:
        if row.sensor_token not in sensor_rows:
            raise _dangling(folder, "calibrated_sensor", "sensor_token", row.sensor_token, "sensor")
    mounted = [sensors[sensor_rows[row.sensor_token]] for row in rows]
    for sensor in mounted:
        _require_plain(folder / "sensor.json", "channel", sensor.channel)
    return Calibrations(
        channel=np.array([sensor.channel for sensor in mounted]),
        is_camera=np.array([sensor.modality == "camera" for sensor in mounted]),
        rotation_wxyz=np.array([row.rotation for row in rows], np.float64),
        translation_m=np.array([row.translation for row in rows], np.float64),
        intrinsics=np.array([_matrix(row.camera_intrinsic) for row in rows], np.float64),
    )


def _matrix(rows: list[list[float]]) -> list[list[float]]:
    return rows if [len(row) for row in rows] == [3, 3, 3] else [[math.nan] * 3] * 3


class _ImageReader:
    """One pass over sample_data: keeps the camera rows and turns their tokens into row numbers."""

    def __init__(
        self, folder: Path, scene_of_sample: dict[str, int], calibration_rows: dict[str, int], cameras: Calibrations
    ) -> None:
        self.folder = folder
        self.scene_of_sample = scene_of_sample
        self.calibration_rows = calibration_rows
        self.is_camera = cameras.is_camera.tolist()
        self.pose_rows: dict[str, int] = {}  # rows of Poses by token, in the order of first use
        self.tokens: set[str] = set()

    def read(self, report: Report) -> Images:
        blocks = [self._images(rows) for rows in read_table(self.folder / "sample_data.json", ImageRow, report)]
        images = Images(*map(np.concatenate, zip(*blocks, strict=True)))
        if not len(images.scene):
            raise InputError(f"{self.folder}/sample_data.json: no camera image among its rows; {CURE}")
        return images

    def _images(self, rows: list[ImageRow]) -> tuple[NDArray[Any], ...]:
        """The columns of Images for the camera rows of one block."""
        calibrations = self._join(rows, "calibrated_sensor", self.calibration_rows)
        wanted = [self.is_camera[number] for number in calibrations]
        rows, calibrations = list(compress(rows, wanted)), list(compress(calibrations, wanted))
        scenes = self._join(rows, "sample", self.scene_of_sample)
        self._require_new_tokens(rows)
        poses = self.pose_rows
        return (
            np.array(scenes, np.int32),
            np.array(calibrations, np.int32),
            np.array([poses.setdefault(row.ego_pose_token, len(poses)) for row in rows], np.int32),
            np.array([row.timestamp for row in rows], np.int64),
            np.array([row.width for row in rows], np.int32),
            np.array([row.height for row in rows], np.int32),
            np.array([row.is_key_frame for row in rows], np.bool_),
            np.array([row.filename for row in rows], np.object_),
        )

    def _join(self, rows: list[ImageRow], target: str, numbers: dict[str, int]) -> list[int]:
        tokens = [getattr(row, f"{target}_token") for row in rows]
        try:
            return [numbers[token] for token in tokens]
        except KeyError as error:
            raise _dangling(self.folder, "sample_data", f"{target}_token", error.args[0], target) from None

    def _require_new_tokens(self, rows: Iterable[_HasToken]) -> None:
        for row in rows:
            if row.token in self.tokens:
                raise _duplicate(self.folder, "sample_data", row.token)
            self.tokens.add(row.token)


def _read_poses(folder: Path, pose_rows: dict[str, int], images: Images, report: Report) -> Poses:
    """The poses that images refer to, one each; others are passed over."""
    poses = Poses(np.zeros(len(pose_rows), np.int64), np.zeros((len(pose_rows), 4)), np.zeros((len(pose_rows), 3)))
    found = np.zeros(len(pose_rows), np.int32)
    for rows in read_table(folder / "ego_pose.json", PoseRow, report):
        wanted = [row for row in rows if row.token in pose_rows]
        numbers = [pose_rows[row.token] for row in wanted]
        np.add.at(found, numbers, 1)
        poses.timestamp_us[numbers] = [row.timestamp for row in wanted]
        poses.rotation_wxyz[numbers] = np.array([row.rotation for row in wanted]).reshape(-1, 4)
        poses.translation_m[numbers] = np.array([row.translation for row in wanted]).reshape(-1, 3)
    _require_each_once(folder, pose_rows, found)
    return poses


def _require_each_once(folder: Path, pose_rows: dict[str, int], found: NDArray[np.int32]) -> None:
    if (found == 1).all():
        return
    tokens = list(pose_rows)
    if (found > 1).any():
        raise _duplicate(folder, "ego_pose", tokens[int(np.argmax(found > 1))])
    raise _dangling(folder, "sample_data", "ego_pose_token", tokens[int(np.argmin(found))], "ego_pose")
