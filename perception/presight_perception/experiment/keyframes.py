"""Keyframes of a data set in nuScenes format: six images, their rig, and where the vehicle is."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import cv2
import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from presight_core.errors import InputError
from presight_core.nuscenes_split import Role, role_of
from presight_core.table import read_table
from presight_perception.models.camera_rig import CameraRig

# nuScenes' six, clockwise from the front left.
CAMERAS = ("CAM_FRONT_LEFT", "CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK_RIGHT", "CAM_BACK", "CAM_BACK_LEFT")
CLOCK = "LIDAR_TOP"  # a sample is where the vehicle was when this sensor fired
STAND_IN_CLOCK = "CAM_FRONT"  # where there is no lidar

Token = Annotated[str, msgspec.Meta(min_length=1)]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # w, x, y, z


class _Log(msgspec.Struct):
    token: Token
    location: str


class _Scene(msgspec.Struct):
    token: Token
    log_token: Token
    name: str
    description: str = ""


class _Sample(msgspec.Struct):
    token: Token
    scene_token: Token
    timestamp: int


class _Sensor(msgspec.Struct):
    token: Token
    channel: str


class _Mounting(msgspec.Struct):
    token: Token
    sensor_token: Token
    translation: Vector
    rotation: Quaternion
    camera_intrinsic: list[list[float]] = []


class _Pose(msgspec.Struct, gc=False):
    token: Token
    translation: Vector
    rotation: Quaternion


class _File(msgspec.Struct, gc=False):
    sample_token: Token
    ego_pose_token: Token
    calibrated_sensor_token: Token
    is_key_frame: bool
    filename: str
    width: int = 0
    height: int = 0


Row = TypeVar("Row", bound=msgspec.Struct)
Linked = TypeVar("Linked")


@dataclass(frozen=True)
class ImageSize:
    """Of an image; the defaults are what the tiny models see."""

    height_px: int = 112
    width_px: int = 200


@dataclass(frozen=True)
class Keyframe:
    """One sample: the images of one moment, half a second from the next."""

    token: str
    scene: str
    city: str
    description: str  # of its scene: nights say so
    timestamp_us: int
    world_from_ego: NDArray[np.float64]  # (4, 4) at the lidar's time
    images: tuple[Path, ...]  # of CAMERAS
    image_size: ImageSize  # of the files
    intrinsics: NDArray[np.float64]  # (N, 3, 3) in their pixels
    ego_from_camera: NDArray[np.float64]  # (N, 4, 4) from where each image was taken to the ego at the lidar's time

    @property
    def role(self) -> Role:
        """What the paper's split uses the scene for."""
        return role_of(self.scene)

    @property
    def is_night(self) -> bool:
        """Whether the scene's description says so."""
        return "night" in self.description.lower()


def read_keyframes(root: Path, version: str) -> list[Keyframe]:
    """All samples with six images, by scene name and time.

    Raises InputError, naming the file, for tables that are missing, damaged or contradict each other, and where no
    sample has all cameras.
    """
    tables = _Tables(Path(root), Path(root) / version)
    files = tables.files()
    poses = tables.poses({file.ego_pose_token for channels in files.values() for file in channels.values()})
    keyframes = [
        tables.keyframe(token, channels, poses) for token, channels in files.items() if set(CAMERAS) <= channels.keys()
    ]
    if not keyframes:
        raise InputError(f"{tables.folder}: no sample has the images of all six cameras; are these nuScenes' tables?")
    return sorted(keyframes, key=lambda keyframe: (keyframe.scene, keyframe.timestamp_us))


def read_images(keyframe: Keyframe, size: ImageSize) -> Tensor:
    """The images (N, 3, H, W), bytes, RGB. Raises InputError for a file that is missing or no image."""
    images = np.empty((len(keyframe.images), size.height_px, size.width_px, 3), np.uint8)
    for image, file in zip(images, keyframe.images, strict=True):
        # Half the width is decoded in half the time, and is still no smaller than what is asked for on nuScenes.
        found = cv2.imread(str(file), cv2.IMREAD_REDUCED_COLOR_2)
        if found is None:
            raise InputError(f"{file}: missing, or no image; extract the data set's archive again")
        image[:] = cv2.resize(found, (size.width_px, size.height_px), interpolation=cv2.INTER_AREA)[..., ::-1]
    return torch.from_numpy(images).permute(0, 3, 1, 2).contiguous()


def rig_of(keyframes: Sequence[Keyframe], size: ImageSize) -> CameraRig:
    """The rigs of some keyframes, in pixels of images of a size."""
    intrinsics = np.stack([keyframe.intrinsics for keyframe in keyframes])
    for rig, keyframe in zip(intrinsics, keyframes, strict=True):
        rig[:, 0] *= size.width_px / keyframe.image_size.width_px
        rig[:, 1] *= size.height_px / keyframe.image_size.height_px
    mounted = np.stack([keyframe.ego_from_camera for keyframe in keyframes])
    return CameraRig(torch.from_numpy(intrinsics).float(), torch.from_numpy(mounted).float())


class _Tables:
    """The tables of one folder, joined by token."""

    def __init__(self, root: Path, folder: Path) -> None:
        self._root, self.folder = root, folder
        self._logs, self._scenes = self._by_token("log", _Log), self._by_token("scene", _Scene)
        self._samples, self._sensors = self._by_token("sample", _Sample), self._by_token("sensor", _Sensor)
        self._mountings = self._by_token("calibrated_sensor", _Mounting)

    def files(self) -> dict[str, dict[str, _File]]:
        """The files of every sample by channel."""
        files: dict[str, dict[str, _File]] = {}
        for block in read_table(self.folder / "sample_data.json", _File):
            for row in (row for row in block if row.is_key_frame):
                mounting = self._linked(
                    "sample_data", self._mountings, row.calibrated_sensor_token, "calibrated_sensor"
                )
                sensor = self._linked("calibrated_sensor", self._sensors, mounting.sensor_token, "sensor")
                files.setdefault(row.sample_token, {})[sensor.channel] = row
        return files

    def poses(self, wanted: set[str]) -> dict[str, NDArray[np.float64]]:
        """`world_from_ego` (4, 4) of the wanted tokens."""
        blocks = read_table(self.folder / "ego_pose.json", _Pose)
        return {row.token: _matrix(row) for block in blocks for row in block if row.token in wanted}

    def keyframe(self, token: str, channels: dict[str, _File], poses: dict[str, NDArray[np.float64]]) -> Keyframe:
        """One sample, joined."""
        sample = self._linked("sample_data", self._samples, token, "sample")
        scene = self._linked("sample", self._scenes, sample.scene_token, "scene")
        world_from_ego_then = {
            channel: self._linked("sample_data", poses, file.ego_pose_token, "ego_pose")
            for channel, file in channels.items()
        }
        world_from_ego = world_from_ego_then.get(CLOCK, world_from_ego_then[STAND_IN_CLOCK])
        ego_from_world = np.linalg.inv(world_from_ego)
        mounted = {camera: self._mountings[channels[camera].calibrated_sensor_token] for camera in CAMERAS}
        first = channels[CAMERAS[0]]
        return Keyframe(
            token=token,
            scene=scene.name,
            city=self._linked("scene", self._logs, scene.log_token, "log").location,
            description=scene.description,
            timestamp_us=sample.timestamp,
            world_from_ego=world_from_ego,
            images=tuple(self._root / channels[camera].filename for camera in CAMERAS),
            image_size=ImageSize(first.height, first.width),
            intrinsics=np.array([row.camera_intrinsic for row in mounted.values()], np.float64),
            ego_from_camera=np.stack(
                [ego_from_world @ world_from_ego_then[camera] @ _matrix(row) for camera, row in mounted.items()]
            ),
        )

    def _by_token(self, table: str, row_type: type[Row]) -> dict[str, Row]:
        blocks: Iterable[list[Any]] = read_table(self.folder / f"{table}.json", row_type)
        return {row.token: row for block in blocks for row in block}

    def _linked(self, table: str, rows: dict[str, Linked], token: str, target: str) -> Linked:
        if token not in rows:
            raise InputError(
                f"{self.folder / table}.json: {token!r} is not in {target}.json; take both tables from the same archive"
            )
        return rows[token]


def _matrix(row: _Pose | _Mounting) -> NDArray[np.float64]:
    w, x, y, z = row.rotation
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    matrix[:3, 3] = row.translation
    return matrix
