"""Which vehicles stand still: those whose points move between two frames as points of the static world would.

Corners on vehicles are tracked from one frame to the next. Camera poses are known, so a point that stands still lies
where its two rays meet: within a pixel of both, and at a depth. A point that moves on its own mostly breaks that; one
that drives straight towards us or ahead of us does not, but then its vehicle would float or sink: its lowest point is
not where the road is. What cannot be told (no baseline, few corners) counts as moving.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from presight_core import classes
from presight_core.cameras import Camera

VEHICLES = ("car", "truck", "bus")
LEAST_BASELINE_M = 0.2  # between the frames; parallax at 20 m is then a hundredth of a radian
LARGEST_ERROR_PX = 1.0  # of a corner against the point where its rays meet; tracking is good to half of that
FARTHEST_M = 60.0  # farther points have next to no parallax
LEAST_SHARE = 0.7  # of a vehicle's corners that must stand still
LEAST_CORNERS = 5  # fewer are chance
CAMERA_HEIGHTS_M = (0.9, 2.6)  # of cars' cameras above the road: the road is that far below
LEAST_PIXELS = 30  # of a vehicle in its label map
MOST_CORNERS = 1000


@dataclass(frozen=True)
class Shot:
    """An image and its camera, at the image's size."""

    rgb: NDArray[np.uint8]
    camera: Camera


def standing_vehicles(labels: NDArray[np.uint8], now: Shot, other: Shot) -> NDArray[np.bool_]:
    """The pixels (h, w) of a label map of `now` that show vehicles which stood still between the two shots."""
    import cv2

    standing = np.zeros(labels.shape, np.bool_)
    vehicles = classes.lookup(VEHICLES)[labels]
    baseline_m = np.linalg.norm(now.camera.world_from_camera[:3, 3] - other.camera.world_from_camera[:3, 3])
    if baseline_m < LEAST_BASELINE_M or not vehicles.any():
        return standing
    corners, matches = _tracks(vehicles, now, other)
    if not len(corners):
        return standing
    points_world, is_consistent = _met(corners, matches, now, other)
    count, blobs, stats, _ = cv2.connectedComponentsWithStats(vehicles.astype(np.uint8))
    scale = np.array(labels.shape[::-1]) / (now.rgb.shape[1], now.rgb.shape[0])
    cells = np.clip((corners * scale).astype(int), 0, np.array(labels.shape[::-1]) - 1)
    owner = blobs[cells[:, 1], cells[:, 0]]
    for blob in range(1, count):
        members = owner == blob
        if stats[blob, cv2.CC_STAT_AREA] < LEAST_PIXELS or members.sum() < LEAST_CORNERS:
            continue
        lowest_px = _lowest(blobs == blob) / scale
        if is_consistent[members].mean() >= LEAST_SHARE and _stands_on_road(
            points_world[members & is_consistent], lowest_px, now.camera
        ):
            standing |= blobs == blob
    return standing


def _tracks(vehicles: NDArray[np.bool_], now: Shot, other: Shot) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners (N, 2) on vehicles, and where they are in the other image; only those that also track back."""
    import cv2

    height, width = now.rgb.shape[:2]
    mask = cv2.resize(vehicles.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    grey, other_grey = (cv2.cvtColor(shot.rgb, cv2.COLOR_RGB2GRAY) for shot in (now, other))
    corners = cv2.goodFeaturesToTrack(grey, MOST_CORNERS, 0.01, 3, mask=mask)
    if corners is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    corners = np.asarray(corners, np.float32).reshape(-1, 1, 2)
    matches, found, _ = cv2.calcOpticalFlowPyrLK(grey, other_grey, corners, corners.copy())
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(other_grey, grey, matches, matches.copy())
    returned = np.linalg.norm(back - corners, axis=-1)[:, 0] < LARGEST_ERROR_PX
    good = (found[:, 0] > 0) & (found_back[:, 0] > 0) & returned
    # OpenCV counts from the first pixel's centre, cameras from its corner.
    return corners[good, 0].astype(np.float64) + 0.5, matches[good, 0].astype(np.float64) + 0.5


def _met(
    corners: NDArray[np.float64], matches: NDArray[np.float64], now: Shot, other: Shot
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Where the rays of each pair come closest (N, 3), world metres, and whether that explains both pixels."""
    (start, first), (other_start, second) = now.camera.rays(corners), other.camera.rays(matches)
    between = other_start - start
    cosine = (first * second).sum(-1)
    sine_squared = np.maximum(1 - cosine**2, 1e-12)
    along = ((first @ between) - cosine * (second @ between)) / sine_squared
    other_along = (cosine * (first @ between) - (second @ between)) / sine_squared
    points = (start + along[:, None] * first + other_start + other_along[:, None] * second) / 2
    errors = [
        np.linalg.norm(shot.camera.project(points)[0] - seen, axis=-1)
        for shot, seen in ((now, corners), (other, matches))
    ]
    in_front = (along > 0) & (other_along > 0) & (along < FARTHEST_M)
    return points, in_front & (np.maximum(*errors) < LARGEST_ERROR_PX)  # NaN behind a camera is not less


def _lowest(blob: NDArray[np.bool_]) -> NDArray[np.float64]:
    """The lowest pixel (2,) of a blob, x and y in its label map."""
    row = int(np.flatnonzero(blob.any(1))[-1])
    return np.array([np.flatnonzero(blob[row]).mean() + 0.5, row + 1.0])


def _stands_on_road(points_world: NDArray[np.float64], lowest_px: NDArray[np.float64], camera: Camera) -> bool:
    """Whether the vehicle's lowest pixel, at its points' median distance, is as far below the camera as a road is."""
    position, (ray,) = camera.rays(lowest_px[None])
    distance_m = np.median(np.linalg.norm(points_world[:, :2] - position[:2], axis=-1))
    drop_m = -ray[2] / np.linalg.norm(ray[:2]) * distance_m
    return CAMERA_HEIGHTS_M[0] < drop_m < CAMERA_HEIGHTS_M[1]
