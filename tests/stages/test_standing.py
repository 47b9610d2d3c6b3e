"""Standing vehicles: a parked car is told from one that drives across, ahead or towards us."""

import cv2
import numpy as np
import pytest

from presight_core.cameras import Camera
from stages.standing import Shot, standing_vehicles

WIDTH_PX, HEIGHT_PX, FOCAL_PX, CAMERA_HEIGHT_M = 640, 360, 500.0, 1.5
CAR, CAR_WIDTH_M, CAR_HEIGHT_M = 13, 1.8, 1.5
STEP_M = 0.8  # that the camera drives between two frames


def camera(forward_m: float) -> Camera:
    """A camera that looks along the world's x axis."""
    intrinsics = np.array([[FOCAL_PX, 0, WIDTH_PX / 2], [0, FOCAL_PX, HEIGHT_PX / 2], [0, 0, 1]])
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    world_from_camera[:3, 3] = forward_m, 0, CAMERA_HEIGHT_M
    return Camera(intrinsics, world_from_camera, WIDTH_PX, HEIGHT_PX)


def shot(forward_m: float, car_m: tuple[float, float]) -> tuple[Shot, np.ndarray]:
    """The rear of a car (forward, left) metres away from the origin, on the road, and its label map."""
    pattern = np.random.default_rng(0).integers(0, 256, (15, 18), np.uint8)
    texture = cv2.GaussianBlur(cv2.resize(pattern, (180, 150), interpolation=cv2.INTER_NEAREST), (0, 0), 2)
    depth_m = car_m[0] - forward_m
    scale = FOCAL_PX / depth_m * CAR_WIDTH_M / 180
    left = WIDTH_PX / 2 + FOCAL_PX * (-car_m[1] - CAR_WIDTH_M / 2) / depth_m
    top = HEIGHT_PX / 2 + FOCAL_PX * (CAMERA_HEIGHT_M - CAR_HEIGHT_M) / depth_m
    place = np.array([[scale, 0, left - 0.5 + scale / 2], [0, scale, top - 0.5 + scale / 2]])
    size = WIDTH_PX, HEIGHT_PX
    grey = cv2.warpAffine(texture, place, size, flags=cv2.INTER_AREA, borderValue=90)
    mask = cv2.warpAffine(np.full((150, 180), CAR, np.uint8), place, size, flags=cv2.INTER_NEAREST)
    return Shot(np.repeat(grey[..., None], 3, -1), camera(forward_m)), mask[::2, ::2]


def share_standing(first_m: tuple[float, float], then_m: tuple[float, float], step_m: float = STEP_M) -> float:
    """The share of the car's pixels that are said to stand, for a car that was at `first_m` and is at `then_m`."""
    before, _ = shot(0.0, first_m)
    now, labels = shot(step_m, then_m)
    standing = standing_vehicles(labels, now, before)
    assert not standing[labels != CAR].any()
    return float(standing[labels == CAR].mean())


def test_a_parked_car_stands():
    assert share_standing((14, 3), (14, 3)) == 1


@pytest.mark.parametrize(
    ("then", "what"), [((14, 2.5), "across"), ((14.8, 3), "ahead of us"), ((13, 3), "towards us"), ((15.6, 3), "away")]
)
def test_a_car_that_drives_does_not_stand(then, what):
    assert share_standing((14, 3), then) == 0, what


def test_without_a_baseline_nothing_can_be_told():
    assert share_standing((14, 3), (14, 3), step_m=0.05) == 0


def test_an_image_without_vehicles_has_none_that_stand():
    now, labels = shot(STEP_M, (14, 3))
    before, _ = shot(0.0, (14, 3))
    assert not standing_vehicles(np.zeros_like(labels), now, before).any()
