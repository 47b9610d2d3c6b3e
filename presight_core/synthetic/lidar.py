"""LIDAR_TOP: the spinning 32-beam lidar (HDL-32E) on the roof of a nuScenes car.

A sweep is instantaneous here: all points are taken at the keyframe's own time, as if undistorted.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from presight_core.frames import rotation_from_quaternion, transform
from presight_core.synthetic.materials import Material
from presight_core.synthetic.raycast import RayCaster, Rays

CHANNEL = "LIDAR_TOP"
POSITION_M = (0.94, 0.0, 1.84)  # on the roof, ego frame
QUATERNION_WXYZ = (0.7078, -0.0065, 0.0106, -0.7063)  # the car "n015": lidar x points right, y forward
BEAM_COUNT = 32
LOWEST_DEG, HIGHEST_DEG = -30.67, 10.67  # HDL-32E data sheet
AZIMUTH_COUNT = 1084  # firings a turn at 20 Hz, one every 46 us
NEAREST_M, FARTHEST_M = 1.0, 100.0
NOISE_M = 0.02  # data sheet: accuracy 2 cm, one sigma
DROPPED_SHARE = 0.02  # returns lost anywhere
GRAZING = 0.03  # cosine of incidence below which so little light comes back that half of the returns are lost


class Sweep(NamedTuple):
    """One turn of the lidar: the returns, and all rays it sent."""

    points: NDArray[np.float32]  # (N, 5) x, y, z in metres, lidar frame; intensity 0..255; ring from the lowest beam
    labels: NDArray[np.uint8]  # (N,) Cityscapes train ids
    instances: NDArray[np.int32]  # (N,) 0: none
    rays: Rays  # without noise, dropped ones included


def ego_from_lidar() -> NDArray[np.float64]:
    """The calibration (4, 4), metres."""
    return transform(rotation_from_quaternion(QUATERNION_WXYZ), POSITION_M)


def sweep(caster: RayCaster, world_from_lidar: NDArray[np.float64], rng: np.random.Generator) -> Sweep:
    """One turn at a pose (4, 4). The own car is not in the scene, so it neither returns nor hides anything."""
    directions_lidar, rings = _directions()
    directions = directions_lidar @ world_from_lidar[:3, :3].T
    origin = world_from_lidar[:3, 3]
    hits = caster.cast(origin, directions)
    distance_m = np.where(hits.distance_m <= FARTHEST_M, hits.distance_m, np.inf)
    rays = Rays(origin, directions, distance_m.astype(np.float32))
    cosine = np.abs(np.einsum("ni,ni->n", directions, caster.normals[hits.faces]))
    kept = np.isfinite(distance_m) & (distance_m >= NEAREST_M)
    kept &= rng.random(len(kept)) >= DROPPED_SHARE + (1 - DROPPED_SHARE) * np.exp2(-cosine / GRAZING)
    faces = hits.faces[kept]
    measured_m = distance_m[kept] + rng.normal(0, NOISE_M, len(faces))
    places = directions_lidar[kept] * measured_m[:, None]
    intensity = _intensity(caster, faces, cosine[kept])
    points = np.c_[places, intensity, rings[kept]].astype(np.float32)
    return Sweep(points, caster.labels[faces], caster.instances[faces], rays)


def write_sweep(path: Path, points: NDArray[np.float32]) -> None:
    """Write points (N, 5) as nuScenes does (`.pcd.bin`): float32 x, y, z, intensity, ring, one after the other."""
    path.write_bytes(np.ascontiguousarray(points, "<f4").tobytes())


def _directions() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Unit directions (AZIMUTH_COUNT * BEAM_COUNT, 3) in the lidar frame, a firing after the other, and their rings."""
    elevation = np.deg2rad(np.linspace(LOWEST_DEG, HIGHEST_DEG, BEAM_COUNT))
    # As real sweeps: from the car's left clockwise, seen from above.
    azimuth = np.pi - np.arange(AZIMUTH_COUNT)[:, None] * 2 * np.pi / AZIMUTH_COUNT
    x, y = np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation)
    directions = np.stack([x, y, np.broadcast_to(np.sin(elevation), x.shape)], -1)
    return directions.reshape(-1, 3), np.tile(np.arange(BEAM_COUNT), AZIMUTH_COUNT)


def _intensity(caster: RayCaster, faces: NDArray[np.int32], cosine: NDArray[np.float64]) -> NDArray[np.float64]:
    """Whole numbers 0..255: diffuse surfaces return up to 100, as Velodyne scales them; signs and plates more."""
    diffuse = 100 * caster.colours[faces].mean(1) * cosine
    is_retroreflector = np.isin(caster.materials[faces], [Material.SIGN, Material.TAIL_LIGHT])
    return np.rint(np.where(is_retroreflector, 110 + 145 * cosine, np.minimum(diffuse, 100)))
