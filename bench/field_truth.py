"""What is true of an embedded city: depth along the rays of its images, and its surface, to judge fields by."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from presight_core import classes
from presight_core.cameras import pixel_centres
from presight_core.drives import Drive, FrameTable
from presight_core.synthetic.dataset import city_of
from presight_core.synthetic.presets import Location
from presight_core.synthetic.surface_points import Bounds, sample_surface

SPACING_M = 0.2  # of true surface points: half a voxel
NEAR_M = 0.4  # a voxel this near to the surface is right, and a surface point this near to a voxel is found
BELOW_M, ABOVE_M = 5.0, 15.0  # heights of the sampled surface: beyond what extraction keeps


@dataclass(frozen=True)
class RayTruth:
    """What the pixels of one image show."""

    directions: NDArray[np.float64]  # (N, 3) world, unit
    distance_m: NDArray[np.float64]  # (N,) along the ray; inf: sky
    labels: NDArray[np.uint8]  # (N,) Cityscapes train ids


class SceneTruth:
    """The ground truth of one embedded city's images."""

    def __init__(self, drives: tuple[Drive, ...], frames: FrameTable) -> None:
        self._frames = frames
        self._folders = {drive.drive_id: Path(drive.root) / "synth_gt" / drive.name for drive in drives}

    def rays(self, row: int, stride: int) -> RayTruth:
        """Every `stride`-th pixel of a row's image."""
        frames, camera = self._frames, self._frames.camera_of(row)
        name = f"{frames.timestamp_us[row]}_{frames.camera[row]}.npz"
        with np.load(self._folders[str(frames.drive_id[row])] / name) as file:
            depth_m, labels = file["depth"].astype(np.float64), file["labels"]
        pixels = pixel_centres(camera.width_px, camera.height_px, stride)
        columns, rows = pixels.astype(np.int64).T
        _, directions = camera.rays(pixels)
        along_axis = directions @ camera.world_from_camera[:3, 2]
        chosen_m = depth_m[rows, columns]
        return RayTruth(directions, np.where(chosen_m > 0, chosen_m / along_axis, np.inf), labels[rows, columns])


class SurfaceTruth:
    """The whole surface of an embedded city, seen from anywhere or not."""

    def __init__(self, root: Path, location: Location) -> None:
        city = city_of(root, location)
        size_m = city.style.size_m
        bounds = Bounds((0.0, 0.0, -BELOW_M), (size_m, size_m, ABOVE_M))
        self._tree = KDTree(sample_surface(city.mesh, SPACING_M, bounds).points)

    def distance_m(self, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance (N,) of points (N, 3) to the nearest surface; inf beyond a metre."""
        return self._tree.query(points_world, distance_upper_bound=1.0)[0]


def static_classes() -> NDArray[np.bool_]:
    """(256,) True at labels of things that stay and have a surface."""
    table = ~classes.lookup((*classes.DYNAMIC, "sky"))
    table[classes.UNKNOWN] = False
    return table
