"""Planes with a pattern that never repeats, as cameras see them: depths are known by formula."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from presight_core.cameras import Camera, pixel_centres
from presight_core.frames import planar_transform

WIDTH, HEIGHT, FOCAL = 96, 64, 90.0
INTRINSICS = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
EYE_M = 1.5
EGO_FROM_CAMERA = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, EYE_M], [0, 0, 0, 1]])
TEXEL_M = 0.1


@dataclass(frozen=True)
class Plane:
    """Points p of the world with p @ normal == offset_m."""

    normal: tuple[float, float, float]
    offset_m: float

    def distance_m(self, camera: Camera) -> NDArray[np.float64]:
        """Along each pixel's ray (H * W,); inf where it meets nothing."""
        origin, directions = camera.rays(pixel_centres(camera.width_px, camera.height_px))
        with np.errstate(divide="ignore"):
            length_m = (self.offset_m - origin @ self.normal) / (directions @ self.normal)
        return np.where(length_m > 0, length_m, np.inf)


def wall(distance_m: float) -> Plane:
    """A wall across the world's x axis."""
    return Plane((1.0, 0.0, 0.0), distance_m)


GROUND = Plane((0.0, 0.0, 1.0), 0.0)


def camera_at(x_m: float, y_m: float, yaw_rad: float = 0.0) -> Camera:
    """A camera 1.5 m above the ground that looks along x, turned to the left."""
    return Camera(INTRINSICS, planar_transform(x_m, y_m, yaw_rad) @ EGO_FROM_CAMERA, WIDTH, HEIGHT)


def depth_m(camera: Camera, *planes: Plane) -> NDArray[np.float64]:
    """Along the optical axis (H, W) of what stands nearest."""
    _, directions = camera.rays(pixel_centres(camera.width_px, camera.height_px))
    nearest_m = np.min([plane.distance_m(camera) for plane in planes], axis=0)
    return (nearest_m * (directions @ camera.world_from_camera[:3, 2])).reshape(camera.height_px, camera.width_px)


def picture(camera: Camera, *planes: Plane) -> NDArray[np.uint8]:
    """The grey image (H, W) of the planes; 0 where there is none."""
    origin, directions = camera.rays(pixel_centres(camera.width_px, camera.height_px))
    lengths_m = np.array([plane.distance_m(camera) for plane in planes])
    nearest = lengths_m.argmin(0)
    met = np.isfinite(lengths_m.min(0))
    points = origin + np.where(met, lengths_m.min(0), 0)[:, None] * directions
    grey = np.zeros(len(points))
    for number, plane in enumerate(planes):
        chosen = met & (nearest == number)
        across = np.argsort(np.abs(plane.normal), kind="stable")[:2]  # the two axes that lie most along the plane
        places = points[chosen][:, across].T / TEXEL_M + 100 * number
        grey[chosen] = map_coordinates(_pattern(), places, order=1, mode="grid-wrap")
    return np.round(grey).astype(np.uint8).reshape(camera.height_px, camera.width_px)


@cache
def _pattern() -> NDArray[np.float64]:
    """Spots of one to a few texels, 0..255, on a square of 1024."""
    fine = np.random.default_rng(0).normal(size=(1024, 1024))
    noise = sum(sigma * gaussian_filter(fine, sigma, mode="wrap") for sigma in (1, 2))
    return np.clip(128 + 50 * noise / noise.std(), 0, 255)
