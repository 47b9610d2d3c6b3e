"""The nuScenes v1.0 tables of synthetic drives: rows, tokens and files as the official schema has them."""

import hashlib
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from presight_core.frames import quaternion_from_rotation
from presight_core.synthetic.drive_plan import DrivePlan, Shot, Turn
from presight_core.synthetic.files import write_json
from presight_core.synthetic.lidar import ego_from_lidar
from presight_core.synthetic.rig import RIG

TABLES = (
    "attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample", "sample_annotation",
    "sample_data", "scene", "sensor", "visibility",
)  # fmt: skip
CATEGORIES = (
    "human.pedestrian.adult", "human.pedestrian.child", "human.pedestrian.wheelchair", "human.pedestrian.stroller",
    "human.pedestrian.personal_mobility", "human.pedestrian.police_officer", "human.pedestrian.construction_worker",
    "animal", "vehicle.car", "vehicle.motorcycle", "vehicle.bicycle", "vehicle.bus.bendy", "vehicle.bus.rigid",
    "vehicle.truck", "vehicle.construction", "vehicle.emergency.ambulance", "vehicle.emergency.police",
    "vehicle.trailer", "movable_object.barrier", "movable_object.trafficcone", "movable_object.pushable_pullable",
    "movable_object.debris", "static_object.bicycle_rack",
)  # fmt: skip
ATTRIBUTES = (
    "vehicle.moving", "vehicle.stopped", "vehicle.parked", "cycle.with_rider", "cycle.without_rider",
    "pedestrian.sitting_lying_down", "pedestrian.standing", "pedestrian.moving",
)  # fmt: skip
MAP_NAMES = {  # token and file name of each map's picture: the devkit looks for these and no others
    "boston-seaport": "36092f0b03a857c6a3403e25b4b7aab3",
    "singapore-hollandvillage": "37819e65e09e5547b8a3ceaefba56bb2",
    "singapore-onenorth": "53992ee3023e5494b90c316c183be829",
    "singapore-queenstown": "93406b464a165eaba6d9de76ca09f5da",
}
VISIBILITY = ("v0-40", "v40-60", "v60-80", "v80-100")  # share of the object that some camera sees, in percent

Row = dict[str, Any]
Rows = dict[str, list[Row]]


@dataclass(frozen=True)
class Box:
    """One annotated object at one keyframe, world frame."""

    instance: int
    category: str
    attribute: str
    centre_m: tuple[float, float, float]
    size_m: tuple[float, float, float]  # width, length, height, as nuScenes orders them
    yaw_rad: float
    visible_share: float
    lidar_points: int


@dataclass(frozen=True)
class Recording:
    """One file that a sensor wrote."""

    channel: str
    path: str  # relative to the data root
    when: Shot | Turn
    format: str
    size_px: tuple[int, int]  # width and height; as in nuScenes 0 for point clouds


def token(*parts: object) -> str:
    """A name of 32 hex digits that depends on nothing but its parts."""
    text = "/".join(str(part) for part in parts)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def image_path(plan: DrivePlan, shot: Shot) -> str:
    """Where an image goes, relative to the data root."""
    folder = "samples" if shot.is_keyframe else "sweeps"
    return f"{folder}/{shot.mount.channel}/{logfile(plan)}__{shot.mount.channel}__{shot.timestamp_us}.jpg"


def truth_path(plan: DrivePlan, shot: Shot) -> str:
    """Where a keyframe's ground truth goes, relative to the data root."""
    return f"synth_gt/{plan.name}/{shot.timestamp_us}_{shot.mount.channel}.npz"


def rows_path(scene: str) -> str:
    """Where the table rows of a drive go, relative to the data root."""
    return f"synth_gt/{scene}/rows.json"


def sweep_path(plan: DrivePlan, turn: Turn) -> str:
    """Where the lidar's points of a turn go, relative to the data root."""
    folder = "samples" if turn.is_keyframe else "sweeps"
    return f"{folder}/LIDAR_TOP/{logfile(plan)}__LIDAR_TOP__{turn.timestamp_us}.pcd.bin"


def occupancy_path(plan: DrivePlan, keyframe: int) -> str:
    """Where the Occ3D labels of a keyframe go, relative to the data root."""
    return f"gts/{plan.name}/{sample_token(plan, keyframe)}/labels.npz"


def logfile(plan: DrivePlan) -> str:
    """Name of the log that a drive is cut from."""
    return f"synth-{plan.captured}-{plan.order.number:04d}"


def sample_token(plan: DrivePlan, keyframe: int) -> str:
    """Token of a keyframe; empty before the first and after the last."""
    return token(plan.name, "sample", keyframe) if 0 <= keyframe < plan.keyframes else ""


# ---- rows --------------------------------------------------------------------------------------------------------


def vocabulary_rows(lidar: bool) -> Rows:
    """Tables that are the same for every data set with or without a lidar."""
    sensors = [(mount.channel, "camera") for mount in RIG] + [("LIDAR_TOP", "lidar")] * lidar
    return {
        "category": [{"token": token("category", c), "name": c, "description": ""} for c in CATEGORIES],
        "attribute": [{"token": token("attribute", a), "name": a, "description": ""} for a in ATTRIBUTES],
        "visibility": [
            {"token": str(number), "level": level, "description": f"visibility of whole object: {level[1:]} %"}
            for number, level in enumerate(VISIBILITY, 1)
        ],
        "sensor": [
            {"token": token("sensor", channel), "channel": channel, "modality": modality}
            for channel, modality in sensors
        ],
    }


def map_path(location: str) -> str:
    """Where the map picture of a city goes, relative to the data root."""
    return f"maps/{MAP_NAMES[location]}.png"


def map_row(location: str, logs: Sequence[Row]) -> Row:
    """The row that ties the logs of a city to the picture of its map."""
    return {
        "token": MAP_NAMES[location],
        "log_tokens": [row["token"] for row in logs if row["location"] == location],
        "category": "semantic_prior",
        "filename": map_path(location),
    }


def recordings(
    plan: DrivePlan, shots: Sequence[Shot], turns: Sequence[Turn], size_px: tuple[int, int]
) -> list[Recording]:
    """All files of a drive's sensors: first the images in their order, then the sweeps of the lidar."""
    images = [Recording(shot.mount.channel, image_path(plan, shot), shot, "jpg", size_px) for shot in shots]
    return images + [Recording("LIDAR_TOP", sweep_path(plan, turn), turn, "pcd", (0, 0)) for turn in turns]


def drive_rows(
    plan: DrivePlan, files: Sequence[Recording], size_px: tuple[int, int], boxes: Mapping[int, Sequence[Box]]
) -> Rows:
    """Rows of one drive. `boxes` holds the annotations of each keyframe, by its number."""
    rows: Rows = {
        "log": [
            {
                "token": token(plan.name, "log"),
                "logfile": logfile(plan),
                "vehicle": "synth",
                "date_captured": plan.captured,
                "location": plan.order.location,
            }
        ],
        "scene": [_scene_row(plan)],
        "sample": _sample_rows(plan),
        "calibrated_sensor": _calibration_rows(plan, size_px, {file.channel for file in files}),
        "ego_pose": [_pose_row(plan, file) for file in files],
        "sample_data": _file_rows(plan, files),
    }
    return rows | _annotation_rows(plan, boxes)


def _scene_row(plan: DrivePlan) -> Row:
    return {
        "token": token(plan.name),
        "log_token": token(plan.name, "log"),
        "nbr_samples": plan.keyframes,
        "first_sample_token": sample_token(plan, 0),
        "last_sample_token": sample_token(plan, plan.keyframes - 1),
        "name": plan.name,
        "description": f"Synthetic city, {plan.order.light}",
    }


def _sample_rows(plan: DrivePlan) -> list[Row]:
    return [
        {
            "token": sample_token(plan, keyframe),
            "timestamp": plan.keyframe_us(keyframe),
            "prev": sample_token(plan, keyframe - 1),
            "next": sample_token(plan, keyframe + 1),
            "scene_token": token(plan.name),
        }
        for keyframe in range(plan.keyframes)
    ]


def _calibration_rows(plan: DrivePlan, size_px: tuple[int, int], channels: Container[str]) -> list[Row]:
    mounted = [(mount.channel, mount.ego_from_camera, mount.intrinsics(*size_px).tolist()) for mount in RIG]
    mounted.append(("LIDAR_TOP", ego_from_lidar(), []))
    return [
        {
            "token": token(plan.name, "calibration", channel),
            "sensor_token": token("sensor", channel),
            "translation": ego_from_sensor[:3, 3].tolist(),
            "rotation": _quaternion(ego_from_sensor),
            "camera_intrinsic": intrinsics,
        }
        for channel, ego_from_sensor, intrinsics in mounted
        if channel in channels
    ]


def _pose_row(plan: DrivePlan, file: Recording) -> Row:
    world_from_ego = plan.recorded_pose(file.when.time_s)
    return {
        "token": token(file.path),
        "timestamp": file.when.timestamp_us,
        "rotation": _quaternion(world_from_ego),
        "translation": world_from_ego[:3, 3].tolist(),
    }


def _file_rows(plan: DrivePlan, files: Sequence[Recording]) -> list[Row]:
    rows: list[Row] = []
    latest: dict[str, Row] = {}
    for file in files:
        previous = latest.get(file.channel)
        row = {
            "token": token(file.path),
            "sample_token": sample_token(plan, file.when.keyframe),
            "ego_pose_token": token(file.path),
            "calibrated_sensor_token": token(plan.name, "calibration", file.channel),
            "timestamp": file.when.timestamp_us,
            "fileformat": file.format,
            "is_key_frame": file.when.is_keyframe,
            "height": file.size_px[1],
            "width": file.size_px[0],
            "filename": file.path,
            "prev": previous["token"] if previous else "",
            "next": "",
        }
        if previous:
            previous["next"] = row["token"]
        latest[file.channel] = row
        rows.append(row)
    return rows


def _annotation_rows(plan: DrivePlan, boxes: Mapping[int, Sequence[Box]]) -> Rows:
    tracks: dict[int, list[tuple[int, Box]]] = {}
    for keyframe in sorted(boxes):
        for box in boxes[keyframe]:
            tracks.setdefault(box.instance, []).append((keyframe, box))
    instances, annotations = [], []
    for instance, track in sorted(tracks.items()):
        names = [token(plan.name, "annotation", instance, keyframe) for keyframe, _ in track]
        instances.append(
            {
                "token": token(plan.name, "instance", instance),
                "category_token": token("category", track[0][1].category),
                "nbr_annotations": len(track),
                "first_annotation_token": names[0],
                "last_annotation_token": names[-1],
            }
        )
        chain = ["", *names, ""]
        for number, (keyframe, box) in enumerate(track):
            annotations.append(_annotation_row(plan, keyframe, box, chain[number : number + 3]))
    return {"instance": instances, "sample_annotation": annotations}


def _annotation_row(plan: DrivePlan, keyframe: int, box: Box, chain: Sequence[str]) -> Row:
    """One box; `chain` is the tokens of the previous annotation of this object, this one and the next."""
    level = int(np.searchsorted([0.4, 0.6, 0.8], box.visible_share, side="right"))
    return {
        "token": chain[1],
        "sample_token": sample_token(plan, keyframe),
        "instance_token": token(plan.name, "instance", box.instance),
        "visibility_token": str(level + 1),
        "attribute_tokens": [token("attribute", box.attribute)] if box.attribute else [],
        "translation": list(box.centre_m),
        "size": list(box.size_m),
        "rotation": [float(np.cos(box.yaw_rad / 2)), 0.0, 0.0, float(np.sin(box.yaw_rad / 2))],
        "prev": chain[0],
        "next": chain[2],
        "num_lidar_pts": box.lidar_points,
        "num_radar_pts": 0,
    }


def _quaternion(a_from_b: NDArray[np.float64]) -> list[float]:
    return quaternion_from_rotation(a_from_b[:3, :3]).tolist()


# ---- tables ------------------------------------------------------------------------------------------------------


def merge(parts: Iterable[Rows]) -> Rows:
    """All rows, table by table, in the given order."""
    merged: Rows = {table: [] for table in TABLES}
    for part in parts:
        for table, rows in part.items():
            merged[table] += rows
    return merged


def write_tables(folder: Path, rows: Rows) -> None:
    """Write every table; `scene.json`, which readers look for first, comes last."""
    for table in sorted(TABLES, key=lambda name: name == "scene"):
        write_json(folder / f"{table}.json", rows[table])
