"""The six cameras of a nuScenes car: where they sit, what they see, and when they fire."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from presight_core.cameras import Camera
from presight_core.frames import transform

CALIBRATED_SIZE_PX = (1600, 900)  # intrinsics below are for this size


@dataclass(frozen=True)
class Mount:
    """One camera: position in the ego frame (metres), attitude (degrees), intrinsics (pixels), firing time."""

    channel: str
    position_m: tuple[float, float, float]
    yaw_pitch_roll_deg: tuple[float, float, float]  # about z, then y, then x of the ego frame
    focal_px: float
    centre_px: tuple[float, float]
    delay_us: int  # after the keyframe's own time; the shutters follow the sweep of the lidar

    @property
    def ego_from_camera(self) -> NDArray[np.float64]:
        """The calibration (4, 4), metres."""
        yaw, pitch, roll = np.deg2rad(self.yaw_pitch_roll_deg)
        camera_axes = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # right, down, forward as ego axes, in columns
        return transform(_about_z(yaw) @ _about_y(pitch) @ _about_x(roll) @ camera_axes, self.position_m)

    def intrinsics(self, width_px: int, height_px: int) -> NDArray[np.float64]:
        """The matrix (3, 3) for images of another size."""
        sx, sy = width_px / CALIBRATED_SIZE_PX[0], height_px / CALIBRATED_SIZE_PX[1]
        cx, cy = self.centre_px
        return np.array([[self.focal_px * sx, 0, cx * sx], [0, self.focal_px * sy, cy * sy], [0, 0, 1]])


# Measured values of the car "n015", rounded to centimetres, hundredths of a degree and tenths of a pixel.
RIG = (
    Mount("CAM_FRONT", (1.70, 0.02, 1.51), (0.33, 0.32, -0.05), 1266.4, (816.3, 491.5), -35_500),
    Mount("CAM_FRONT_RIGHT", (1.55, -0.49, 1.50), (-56.40, 0.78, 0.52), 1260.8, (808.0, 495.3), -27_600),
    Mount("CAM_FRONT_LEFT", (1.52, 0.49, 1.51), (55.16, -0.14, 0.12), 1272.6, (826.6, 479.8), -43_100),
    Mount("CAM_BACK", (0.03, 0.00, 1.58), (179.86, -0.96, 0.23), 809.2, (829.2, 481.8), -10_400),
    Mount("CAM_BACK_LEFT", (1.04, 0.48, 1.59), (108.60, 0.92, -0.22), 1256.7, (792.1, 492.8), -500),
    Mount("CAM_BACK_RIGHT", (1.01, -0.48, 1.56), (-110.79, 0.93, 0.62), 1259.5, (807.3, 501.2), -20_100),
)


def rig_camera(mount: Mount, world_from_ego: NDArray[np.float64], width_px: int, height_px: int) -> Camera:
    """One camera of the rig at an ego pose (4, 4)."""
    return Camera(
        mount.intrinsics(width_px, height_px), world_from_ego @ mount.ego_from_camera, int(width_px), int(height_px)
    )


def rig_cameras(world_from_ego: NDArray[np.float64], width_px: int, height_px: int) -> tuple[Camera, ...]:
    """All six cameras at one ego pose, in the order of RIG."""
    return tuple(rig_camera(mount, world_from_ego, width_px, height_px) for mount in RIG)


def _about_x(angle: float) -> NDArray[np.float64]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def _about_y(angle: float) -> NDArray[np.float64]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def _about_z(angle: float) -> NDArray[np.float64]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
