"""A data set of two scenes in nuScenes format, one to train on and one, at night, to test on, at a crossroads."""

import json
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from presight_perception.experiment.keyframes import CAMERAS
from presight_perception.occupancy_truth import OCCUPANCY_CLASSES
from tests.perception.toy_map import crossroads
from tests.perception.toy_rig import EGO_FROM_FRONT

VERSION = "v1.0-trainval"
TRAIN_SCENE, TEST_SCENE = "scene-0062", "scene-0001"
KEYFRAMES = 4  # a scene
STEP_M = 2.0  # between keyframes, along x
LATE_M = 0.5  # what the vehicle has moved between the lidar's time and the cameras'
WIDTH_PX, HEIGHT_PX = 64, 36


def write_dataset(root: Path) -> Path:
    """The data set's root."""
    random = np.random.default_rng(0)
    mountings = [_mounting(number, camera) for number, camera in enumerate(CAMERAS)]
    mountings.append({**mountings[0], "token": "mounting-LIDAR_TOP", "sensor_token": "sensor-LIDAR_TOP"})
    tables: dict[str, list[dict]] = {
        "log": [{"token": "log", "location": "town"}],
        "scene": [
            {"token": TRAIN_SCENE, "log_token": "log", "name": TRAIN_SCENE, "description": "Parked cars"},
            {"token": TEST_SCENE, "log_token": "log", "name": TEST_SCENE, "description": "Night, rain"},
        ],
        "sensor": [{"token": f"sensor-{channel}", "channel": channel} for channel in [*CAMERAS, "LIDAR_TOP"]],
        "calibrated_sensor": mountings,
        "sample": [],
        "sample_data": [],
        "ego_pose": [],
    }
    for scene in (TRAIN_SCENE, TEST_SCENE):
        for number in range(KEYFRAMES):
            _add_sample(root, tables, scene, number, random)
    (root / VERSION).mkdir(parents=True)
    for name, rows in tables.items():
        (root / VERSION / f"{name}.json").write_text(json.dumps(rows))
    expansion = root / "maps" / "expansion"
    expansion.mkdir(parents=True)
    (expansion / "town.json").write_text(json.dumps(crossroads((0.0, 0.0)).tables))
    return root


def _mounting(number: int, camera: str) -> dict:
    turned = Rotation.from_euler("z", (1 - number) * np.pi / 3).as_matrix() @ EGO_FROM_FRONT[:3, :3]
    x, y, z, w = Rotation.from_matrix(turned).as_quat()
    intrinsic = [[32.0, 0, WIDTH_PX / 2], [0, 32.0, HEIGHT_PX / 2], [0, 0, 1]]
    return {
        "token": f"mounting-{camera}", "sensor_token": f"sensor-{camera}", "translation": [0, 0, 1.5],
        "rotation": [w, x, y, z], "camera_intrinsic": intrinsic,
    }  # fmt: skip


def _add_sample(
    root: Path, tables: dict[str, list[dict]], scene: str, number: int, random: np.random.Generator
) -> None:
    token = f"{scene}-{number}"
    tables["sample"].append({"token": token, "scene_token": scene, "timestamp": number * 500_000})
    for channel in [*CAMERAS, "LIDAR_TOP"]:
        late = 0.0 if channel == "LIDAR_TOP" else LATE_M
        pose = {"token": f"{token}-{channel}", "translation": [number * STEP_M + late, 0, 0], "rotation": [1, 0, 0, 0]}
        tables["ego_pose"].append(pose)
        file = f"samples/{channel}/{token}.{'pcd.bin' if channel == 'LIDAR_TOP' else 'jpg'}"
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        tables["sample_data"].append(
            {
                "sample_token": token,
                "ego_pose_token": pose["token"],
                "is_key_frame": True,
                "filename": file,
                "calibrated_sensor_token": f"mounting-{channel}",
                "width": WIDTH_PX,
                "height": HEIGHT_PX,
            }
        )
        if channel == "LIDAR_TOP":
            random.uniform(-20, 20, (500, 5)).astype("<f4").tofile(root / file)
            _write_occupancy(root / "gts" / scene / token, random)
        else:
            cv2.imwrite(str(root / file), random.integers(0, 256, (HEIGHT_PX, WIDTH_PX, 3)).astype(np.uint8))


def _write_occupancy(folder: Path, random: np.random.Generator) -> None:
    """Occ3D's labels: any class anywhere, all of it seen."""
    semantics = random.integers(0, len(OCCUPANCY_CLASSES), (200, 200, 16)).astype(np.uint8)
    seen = np.ones(semantics.shape, np.uint8)
    folder.mkdir(parents=True)
    np.savez_compressed(folder / "labels.npz", semantics=semantics, mask_camera=seen, mask_lidar=seen)
