"""What the tables alone say against a camera image: its time, its pose, its calibration."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from presight_core.drives import Reject
from stages.image_folder import printable
from stages.nuscenes import Calibrations, Dataset, Images, Poses

EARLIEST_US = 946_684_800_000_000  # 2000-01-01: times in seconds or milliseconds fall before it
LATEST_US = 4_102_444_800_000_000  # 2100-01-01: times in nanoseconds fall after it
POSE_DELAY_US = 50_000  # a metre at 20 m/s: a pose further off in time is another moment's
QUATERNION_TOLERANCE = 1e-3  # four rounded decimals stay below; scaled rotations and angles do not
FAR_M = 2e7  # half way round the Earth
SENSOR_DISTANCE_M = 30.0  # no camera sits farther from its own vehicle's origin


@dataclass(frozen=True)
class Faults:
    """Which images are refused by which rule."""

    dataset: Dataset
    rules: "tuple[Rule, ...]"
    first: NDArray[np.int8]  # (N,) index of the first rule that each image breaks; -1 for none

    def reject(self, row: int) -> Reject:
        """The reject of a faulty row."""
        rule = self.rules[self.first[row]]
        detail = f"{printable(self.dataset.images.path[row])}: {rule.detail(row)}"
        return Reject(rule.code, str(rule.file), detail, rule.cure)


@dataclass(frozen=True)
class Rule:
    """A reason to refuse images, and those it hits."""

    code: str
    file: Path
    hits: NDArray[np.bool_]  # (N,)
    detail: Callable[[int], str]  # of an image's row
    cure: str


def find_faults(dataset: Dataset) -> Faults:
    """The images that the tables themselves rule out."""
    rules = (
        _time_rule(dataset),
        _same_time_rule(dataset),
        _pose_rule(dataset),
        _pose_time_rule(dataset),
        _calibration_rule(dataset),
        _intrinsics_rule(dataset),
    )
    first = np.full(len(dataset.images.scene), -1, np.int8)
    for index in reversed(range(len(rules))):
        first[rules[index].hits] = index
    return Faults(dataset, rules, first)


def _time_rule(dataset: Dataset) -> Rule:
    time_us = dataset.images.timestamp_us
    return Rule(
        code="time-invalid",
        file=dataset.folder / "sample_data.json",
        hits=(time_us < EARLIEST_US) | (time_us > LATEST_US),
        detail=lambda row: f"timestamp {time_us[row]} is not within 2000 .. 2100 in microseconds",
        cure="write timestamps as Unix time in microseconds",
    )


def _same_time_rule(dataset: Dataset) -> Rule:
    images = dataset.images
    return Rule(
        code="time-twice",
        file=dataset.folder / "sample_data.json",
        hits=_same_moment(images, dataset.calibrations),
        detail=lambda row: f"another image of its camera and scene has the same timestamp {images.timestamp_us[row]}",
        cure="keep one of them",
    )


def _same_moment(images: Images, calibrations: Calibrations) -> NDArray[np.bool_]:
    """Which images share scene, camera and time with another: one of them is wrong, and none can tell which."""
    camera = np.unique(calibrations.channel, return_inverse=True)[1][images.calibration]
    order = np.lexsort((images.timestamp_us, camera, images.scene))
    keys = np.stack([images.scene, camera, images.timestamp_us], -1)[order]
    as_next = np.append((keys[1:] == keys[:-1]).all(-1), False)
    hits = np.zeros(len(order), np.bool_)
    hits[order] = as_next | np.roll(as_next, 1)
    return hits


def _pose_rule(dataset: Dataset) -> Rule:
    pose, poses = dataset.images.pose, dataset.poses
    return Rule(
        code="pose-invalid",
        file=dataset.folder / "ego_pose.json",
        hits=~_is_pose(poses.rotation_wxyz, poses.translation_m, FAR_M)[pose],
        detail=lambda row: _pose_detail(poses.rotation_wxyz[pose[row]], poses.translation_m[pose[row]]),
        cure="the rotation must be a unit quaternion w, x, y, z, the translation finite metres",
    )


def _pose_time_rule(dataset: Dataset) -> Rule:
    delay_us = _delay_us(dataset.images, dataset.poses)
    return Rule(
        code="pose-time",
        file=dataset.folder / "ego_pose.json",
        hits=np.abs(delay_us) > POSE_DELAY_US,
        detail=lambda row: f"its ego pose is of another moment, {delay_us[row] / 1e6:.3f} s off",
        cure="give every image the pose of its own timestamp",
    )


def _delay_us(images: Images, poses: Poses) -> NDArray[np.float64]:
    return poses.timestamp_us[images.pose].astype(np.float64) - images.timestamp_us


def _calibration_rule(dataset: Dataset) -> Rule:
    calibration, cameras = dataset.images.calibration, dataset.calibrations
    rotation, translation = cameras.rotation_wxyz, cameras.translation_m
    return Rule(
        code="calibration-invalid",
        file=dataset.folder / "calibrated_sensor.json",
        hits=~_is_pose(rotation, translation, SENSOR_DISTANCE_M)[calibration],
        detail=lambda row: _pose_detail(rotation[calibration[row]], translation[calibration[row]]),
        cure="the rotation must be a unit quaternion w, x, y, z, the translation metres on the vehicle",
    )


def _intrinsics_rule(dataset: Dataset) -> Rule:
    images, intrinsics = dataset.images, dataset.calibrations.intrinsics
    is_pinhole = _is_pinhole(intrinsics)[images.calibration]
    centre = intrinsics[images.calibration, :2, 2]
    size = np.stack([images.width_px, images.height_px], -1)
    return Rule(
        code="intrinsics-invalid",
        file=dataset.folder / "calibrated_sensor.json",
        hits=~is_pinhole | ~((centre > 0) & (centre < size)).all(-1),
        detail=lambda row: f"camera_intrinsic {intrinsics[images.calibration[row]].tolist()} for {size[row]} pixels",
        cure="give the pinhole matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] of the full-size image, in pixels",
    )


def _is_pose(rotation_wxyz: NDArray[np.float64], translation_m: NDArray[np.float64], far_m: float) -> NDArray[np.bool_]:
    """Which rotations (N, 4) are unit quaternions beside translations (N, 3) within `far_m`; NaN is neither."""
    with np.errstate(over="ignore"):  # a squared 1e200 is infinite, and refused as such
        is_unit = np.abs(np.linalg.norm(rotation_wxyz, axis=-1) - 1) < QUATERNION_TOLERANCE
        return is_unit & (np.linalg.norm(translation_m, axis=-1) < far_m)


def _pose_detail(rotation_wxyz: NDArray[np.float64], translation_m: NDArray[np.float64]) -> str:
    return f"rotation {rotation_wxyz.tolist()}, translation {translation_m.tolist()}"


def _is_pinhole(intrinsics: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which matrices (K, 3, 3) project as a pinhole camera; NaN does not."""
    focal = intrinsics[:, [0, 1], [0, 1]]
    return (np.isfinite(focal) & (focal > 0)).all(-1) & _is_affine(intrinsics)


def _is_affine(intrinsics: NDArray[np.float64]) -> NDArray[np.bool_]:
    upper = np.isfinite(intrinsics).all((-1, -2)) & (intrinsics[:, 1, 0] == 0)
    return upper & (intrinsics[:, 2] == [0, 0, 1]).all(-1)
