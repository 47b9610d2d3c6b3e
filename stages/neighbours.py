"""Which other images show what an image shows, from a place that is neither too near nor too far."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from presight_core.drives import FrameTable

REACH_M = 14.0  # between cameras: things 10 m away are then seen from quite another side
MANY = 400  # images within reach; of more, every so many-th is looked at
DISTANCES_M = (6.0, 11.0, 20.0, 40.0)  # of the places by which views are compared
PLACES = (6, 3)  # along an image's width and height
MARGINS = (0.1, 0.25)  # of width and height: what lies at the rim is in few other images
BEST_RAD, LARGEST_RAD = np.radians([6.0, 12.0])  # between two looks at a place; beyond, surfaces look different


class Neighbours:
    """Frames, searched by how much they see of the same."""

    def __init__(self, frames: FrameTable) -> None:
        self._frames = frames
        self._tree = KDTree(frames.positions)
        self._pixel_from_world = frames.intrinsics @ frames.world_from_camera[:, :3, :3].swapaxes(1, 2)
        self._size_px = np.stack([frames.width_px, frames.height_px], -1)

    def of(self, row: int) -> NDArray[np.int64]:
        """Rows whose images, of the same size, can be compared with a row's image, the best first."""
        near = np.array(self._tree.query_ball_point(self._frames.positions[row], REACH_M), np.int64)
        rows = near[(near != row) & (self._size_px[near] == self._size_px[row]).all(-1)]
        rows = rows[:: -(-len(rows) // MANY) or 1]
        places = self._places(row)
        worth = (self._sees(rows, places) * _worth_of_angle(self._angles(row, rows, places))).sum(1)
        order = np.argsort(-worth, kind="stable")
        return rows[order[worth[order] > 0]]

    def _places(self, row: int) -> NDArray[np.float64]:
        """Places (P, 3) in the world at which a row's camera looks."""
        camera = self._frames.camera_of(row)
        across, down = (np.linspace(m, 1 - m, n) for m, n in zip(MARGINS, PLACES, strict=True))
        pixels = np.stack(np.meshgrid(across * camera.width_px, down * camera.height_px), -1).reshape(-1, 2)
        origin, directions = camera.rays(pixels)
        return (origin + directions[:, None] * np.array(DISTANCES_M)[:, None]).reshape(-1, 3)

    def _sees(self, rows: NDArray[np.int64], places: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which rows' images (R, P) hold places (P, 3)."""
        offsets = places - self._frames.positions[rows][:, None]
        seen = np.einsum("rij,rpj->rpi", self._pixel_from_world[rows], offsets)
        corner = self._size_px[rows][:, None] * seen[..., 2:]
        return (seen[..., 2] > 0) & (seen[..., :2] > 0).all(-1) & (seen[..., :2] < corner).all(-1)

    def _angles(self, row: int, rows: NDArray[np.int64], places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Between the looks of a row and of others at places: radians (R, P)."""
        own, others = (places - self._frames.positions[each][..., None, :] for each in (row, rows))
        lengths = np.linalg.norm(own, axis=-1) * np.linalg.norm(others, axis=-1)
        return np.arccos(np.clip((own * others).sum(-1) / np.maximum(lengths, 1e-9), -1, 1))


def _worth_of_angle(angle_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """0..1: small angles tell little of depth, large ones show another side of things."""
    too_large = np.maximum(angle_rad - LARGEST_RAD, 0) / LARGEST_RAD
    return np.minimum(angle_rad / BEST_RAD, 1) * np.exp(-too_large)
