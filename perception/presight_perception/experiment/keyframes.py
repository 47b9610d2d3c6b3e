"""Keyframes of a data set in nuScenes format: six images, their rig, and where the vehicle is."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from presight_core import frames
from presight_core.errors import InputError
from presight_core.nuscenes_split import Role, role_of
from presight_perception.lidar_sweeps import CHANNEL, Sweep, sweep_of
from presight_perception.models.camera_rig import LEAST_DEPTH_M, CameraRig
from presight_perception.nuscenes_tables import FileRow, NuscenesTables, PoseRow, Rows

# nuScenes' six, clockwise from the front left.
CAMERAS = ("CAM_FRONT_LEFT", "CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK_RIGHT", "CAM_BACK", "CAM_BACK_LEFT")
CLOCK = CHANNEL  # a sample is where the vehicle was when the lidar fired
STAND_IN_CLOCK = "CAM_FRONT"  # where there is no lidar


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
    sweep: Sweep | None  # of the lidar, if there is one

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
    tables = NuscenesTables(root, version)
    files = tables.keyframe_files()
    poses = tables.poses(row for channels in files.values() for row in channels.values())
    keyframes = [
        _keyframe(tables, poses, token, channels)
        for token, channels in files.items()
        if set(CAMERAS) <= channels.keys()
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


def lidar_depth(keyframe: Keyframe, size: ImageSize) -> Tensor | None:
    """Depths (N, H, W) of the lidar's returns along the cameras' axes, metres, the nearest of a pixel; else 0."""
    if keyframe.sweep is None:
        return None
    points, rig = keyframe.sweep.points_ego(), rig_of([keyframe], size)
    depth = np.full((len(keyframe.images), size.height_px, size.width_px), np.inf, np.float32)
    for picture, ego_from_camera, intrinsics in zip(
        depth, keyframe.ego_from_camera, rig.intrinsics[0].numpy(), strict=True
    ):
        points_camera = frames.apply(frames.invert(ego_from_camera), points)
        points_camera = points_camera[points_camera[:, 2] > LEAST_DEPTH_M]
        column, row = np.floor((points_camera @ intrinsics.T)[:, :2] / points_camera[:, 2:]).astype(int).T
        seen = (column >= 0) & (column < size.width_px) & (row >= 0) & (row < size.height_px)
        np.minimum.at(picture, (row[seen], column[seen]), points_camera[seen, 2])
    return torch.from_numpy(np.where(np.isinf(depth), 0, depth))


def _keyframe(tables: NuscenesTables, poses: Rows[PoseRow], token: str, channels: dict[str, FileRow]) -> Keyframe:
    """One sample, joined."""
    scene = tables.scene_of(token)
    world_from_ego_then = {channel: poses[row.ego_pose_token].transform for channel, row in channels.items()}
    world_from_ego = world_from_ego_then.get(CLOCK, world_from_ego_then[STAND_IN_CLOCK])
    ego_from_world = frames.invert(world_from_ego)
    mounted = {camera: tables.calibrations[channels[camera].calibrated_sensor_token] for camera in CAMERAS}
    first = channels[CAMERAS[0]]
    return Keyframe(
        token=token,
        scene=scene.name,
        city=tables.city_of(scene),
        description=scene.description,
        timestamp_us=tables.samples[token].timestamp,
        world_from_ego=world_from_ego,
        images=tuple(tables.root / channels[camera].filename for camera in CAMERAS),
        image_size=ImageSize(first.height, first.width),
        intrinsics=np.array([row.camera_intrinsic for row in mounted.values()], np.float64),
        ego_from_camera=np.stack(
            [ego_from_world @ world_from_ego_then[camera] @ row.transform for camera, row in mounted.items()]
        ),
        sweep=sweep_of(tables, scene, channels[CLOCK], world_from_ego) if CLOCK in channels else None,
    )
