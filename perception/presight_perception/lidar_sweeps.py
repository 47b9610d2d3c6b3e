"""Which lidar sweeps the drives of a data set in the nuScenes format have, and where the vehicle was."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from presight_core import frames
from presight_core.errors import InputError
from presight_perception.nuscenes_tables import FileRow, NuscenesTables, SceneRow

CHANNEL = "LIDAR_TOP"
POINT_VALUES = 5  # float32 each: x, y, z in metres, intensity, ring


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


def read_sweeps(root: Path, version: str, drives: Collection[str]) -> list[Sweep]:
    """The keyframe sweeps of the drives (scene names), in the order of the table `root / version / sample_data.json`.

    Raises InputError for a missing or damaged table, rows that name each other in vain, and a drive that is not
    there or has no sweep.
    """
    tables, wanted = NuscenesTables(root, version), set(drives)
    files = {
        token: channels[CHANNEL]
        for token, channels in tables.keyframe_files().items()
        if CHANNEL in channels and tables.scene_of(token).name in wanted
    }
    missing = sorted(wanted - {tables.scene_of(token).name for token in files})
    if missing:
        raise InputError(
            f"{tables.folder}: no {CHANNEL} keyframes of {', '.join(missing)}; choose drives that have them"
        )
    poses = tables.poses(files.values())
    return [
        sweep_of(tables, tables.scene_of(token), row, poses[row.ego_pose_token].transform)
        for token, row in files.items()
    ]


def sweep_of(tables: NuscenesTables, scene: SceneRow, row: FileRow, world_from_ego: NDArray[np.float64]) -> Sweep:
    """The sweep in a file of the lidar; `world_from_ego` (4, 4) at its time."""
    ego_from_lidar = tables.calibrations[row.calibrated_sensor_token].transform
    return Sweep(scene.name, tables.city_of(scene), tables.root / row.filename, ego_from_lidar, world_from_ego)
