"""Rigid transforms between the frames world, ego and camera.

Transforms are 4 x 4 float64 matrices named `a_from_b`, so that equal names meet:
`world_from_camera = world_from_ego @ ego_from_camera`. Units are metres.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

ROTATION_TOLERANCE = 1e-4  # float32 poses and rounded JSON stay below; shears and scales do not


def rotation_from_quaternion(quaternion_wxyz: ArrayLike) -> NDArray[np.float64]:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4) in the order w, x, y, z, of any length but zero."""
    quaternion = np.asarray(quaternion_wxyz, np.float64)
    quaternion = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def quaternion_from_rotation(rotation: ArrayLike) -> NDArray[np.float64]:
    """The unit quaternion (4,), w, x, y, z with w >= 0, of one rotation matrix (3, 3).

    Taken as the dominant eigenvector of Bar-Itzhack's symmetric matrix: stable for every angle.
    """
    r = np.asarray(rotation, np.float64)
    k = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], 0, 0, 0],
            [r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], 0, 0],
            [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1], 0],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], np.trace(r)],
        ]
    )
    x, y, z, w = np.linalg.eigh(k)[1][:, -1]
    quaternion = np.array([w, x, y, z])
    return quaternion if w >= 0 else -quaternion


def transform(rotation: ArrayLike, translation_m: ArrayLike) -> NDArray[np.float64]:
    """Transforms (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3)."""
    rotation = np.asarray(rotation, np.float64)
    a_from_b = np.zeros((*rotation.shape[:-2], 4, 4))
    a_from_b[..., :3, :3] = rotation
    a_from_b[..., :3, 3] = translation_m
    a_from_b[..., 3, 3] = 1
    return a_from_b


def planar_transform(x_m: float, y_m: float, yaw_rad: float) -> NDArray[np.float64]:
    """`world_from_ego` of a vehicle standing level at (x, y), heading `yaw_rad` counter-clockwise from east."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return transform([[c, -s, 0], [s, c, 0], [0, 0, 1]], [x_m, y_m, 0])


def invert(a_from_b: NDArray[np.float64]) -> NDArray[np.float64]:
    """`b_from_a` of rigid transforms (..., 4, 4)."""
    rotation = np.swapaxes(a_from_b[..., :3, :3], -1, -2)
    return transform(rotation, -np.einsum("...ij,...j->...i", rotation, a_from_b[..., :3, 3]))


def apply(a_from_b: NDArray[np.float64], points_b: ArrayLike) -> NDArray[np.float64]:
    """Points (N, 3) of frame b, in frame a."""
    return np.asarray(points_b, np.float64) @ a_from_b[:3, :3].T + a_from_b[:3, 3]


def is_rigid(a_from_b: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of the matrices (..., 4, 4) are finite, right-handed and without scale or shear."""
    rotation = a_from_b[..., :3, :3]
    finite = np.asarray(np.isfinite(a_from_b).all((-1, -2)))
    rotation = np.where(finite[..., None, None], rotation, 0)
    gram = rotation @ np.swapaxes(rotation, -1, -2)
    orthonormal = np.abs(gram - np.eye(3)).max((-1, -2)) < ROTATION_TOLERANCE
    return finite & orthonormal & (np.linalg.det(rotation) > 0)
