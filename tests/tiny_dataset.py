"""A data set in the nuScenes format, as small as can be, whose every row a test may spoil."""

import io
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

START_US = 1_600_000_000_000_000
WIDTH_PX, HEIGHT_PX = 32, 24
CAMERAS = ("CAM_FRONT", "CAM_BACK")
IDENTITY = [1.0, 0.0, 0.0, 0.0]
FACING_FORWARD = [0.5, -0.5, 0.5, -0.5]  # ego_from_camera of a camera looking along x


def _jpeg() -> bytes:
    picture = io.BytesIO()
    gradient = np.linspace(0, 255, WIDTH_PX * HEIGHT_PX * 3).reshape(HEIGHT_PX, WIDTH_PX, 3).astype(np.uint8)
    Image.fromarray(gradient).save(picture, "JPEG")
    return picture.getvalue()


@dataclass
class TinyDataset:
    """Two scenes of two keyframes; each camera has a keyframe and a sweep a keyframe; one lidar beside them."""

    root: Path
    version: str = "v1.0-mini"
    tables: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    jpeg: bytes = field(default_factory=_jpeg)

    def __post_init__(self) -> None:
        self.tables = {name: [] for name in ("log", "scene", "sample", "sample_data", "ego_pose")}
        channels = [*CAMERAS, "LIDAR_TOP"]
        modalities = ["camera", "camera", "lidar"]
        self.tables["sensor"] = [
            {"token": f"sensor-{channel}", "channel": channel, "modality": modality}
            for channel, modality in zip(channels, modalities, strict=True)
        ]
        self.tables["calibrated_sensor"] = [self._calibration(channel) for channel in channels]
        self.tables["log"] = [
            {"token": "log-0", "logfile": "l", "vehicle": "v", "date_captured": "2020-09-13", "location": "toytown"}
        ]
        for scene in range(2):
            self._add_scene(scene)

    def _calibration(self, channel: str) -> dict[str, Any]:
        intrinsics = [[20.0, 0.0, 16.0], [0.0, 20.0, 12.0], [0.0, 0.0, 1.0]]
        return {
            "token": f"mounted-{channel}",
            "sensor_token": f"sensor-{channel}",
            "translation": [1.0, 0.0, 1.5],
            "rotation": FACING_FORWARD,
            "camera_intrinsic": intrinsics if channel.startswith("CAM") else [],
        }

    def _add_scene(self, scene: int) -> None:
        samples = [f"sample-{scene}-{number}" for number in range(2)]
        self.tables["scene"].append(
            {
                "token": f"scene-{scene}",
                "log_token": "log-0",
                "name": f"scene-000{scene}",
                "nbr_samples": 2,
                "first_sample_token": samples[0],
                "last_sample_token": samples[1],
            }
        )
        for number, sample in enumerate(samples):
            time_us = START_US + scene * 20_000_000 + number * 500_000
            row = {"token": sample, "timestamp": time_us, "scene_token": f"scene-{scene}"}
            links = {"prev": samples[0] if number else "", "next": "" if number else samples[1]}
            self.tables["sample"].append(row | links)
            for delay_us, folder in ((0, "samples"), (83_000, "sweeps")):
                for channel in (*CAMERAS, "LIDAR_TOP"):
                    self._add_file(channel, sample, time_us + delay_us, folder)

    def _add_file(self, channel: str, sample: str, time_us: int, folder: str) -> None:
        token = f"{channel}-{time_us}"
        is_camera = channel.startswith("CAM")
        seconds = (time_us - START_US) / 1e6
        self.tables["ego_pose"].append(
            {"token": token, "timestamp": time_us, "rotation": IDENTITY, "translation": [10 * seconds, 5.0, 0.0]}
        )
        self.tables["sample_data"].append(
            {
                "token": token,
                "sample_token": sample,
                "ego_pose_token": token,
                "calibrated_sensor_token": f"mounted-{channel}",
                "timestamp": time_us,
                "fileformat": "jpg" if is_camera else "pcd",
                "is_key_frame": folder == "samples",
                "height": HEIGHT_PX if is_camera else 0,
                "width": WIDTH_PX if is_camera else 0,
                "filename": f"{folder}/{channel}/{token}.jpg",
                "prev": "",
                "next": "",
            }
        )

    @property
    def folder(self) -> Path:
        """The table folder."""
        return self.root / self.version

    @property
    def images(self) -> list[dict[str, Any]]:
        """The camera rows of sample_data."""
        return [row for row in self.tables["sample_data"] if row["fileformat"] == "jpg"]

    def write(self) -> Path:
        """Write tables and images; the root."""
        self.write_tables()
        for row in self.images:
            file = self.root / row["filename"]
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(self.jpeg)
        return self.root

    def write_tables(self) -> None:
        """Write the tables, whatever images they name."""
        self.folder.mkdir(parents=True, exist_ok=True)
        for name, rows in self.tables.items():
            (self.folder / f"{name}.json").write_text(json.dumps(rows, indent=0))
