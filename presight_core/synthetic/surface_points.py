"""Evenly spread points on the surfaces of a city: ground truth for geometry, and what occupancy is counted from."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from presight_core.classes import CITYSCAPES
from presight_core.synthetic.mesh import Mesh
from presight_core.synthetic.raycast import RayCaster

GROUND_LABELS = [CITYSCAPES.index(name) for name in ("road", "sidewalk", "terrain")]
BUILDING = CITYSCAPES.index("building")
LIFT_M = 0.002  # rays leave a surface from this far above it
BURIED_M = 0.5  # the ground's own layers lie closer together than this
GOLDEN = (0.7548776662466927, 0.5698402909980532)  # 1 / p and 1 / p**2 with p**3 = p + 1: Roberts' R2 sequence


class Bounds(NamedTuple):
    """An upright box, world metres."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]


class SurfacePoints(NamedTuple):
    """Points on surfaces, each standing for an equal area."""

    points: NDArray[np.float32]  # (N, 3) world metres; float32 resolves 0.1 mm at 1 km
    labels: NDArray[np.uint8]  # (N,) Cityscapes train ids
    faces: NDArray[np.int32]  # (N,) of the mesh

    def select(self, rows: NDArray) -> "SurfacePoints":
        """The given rows: a boolean mask or an index array."""
        return SurfacePoints(self.points[rows], self.labels[rows], self.faces[rows])


def sample_surface(
    mesh: Mesh, spacing_m: float, bounds: Bounds | None = None, faces: NDArray | None = None
) -> SurfacePoints:
    """One point for each square of `spacing_m`, of all faces or of the given ones; no randomness.

    Faces are laid end to end by area and cut into equal steps, so that many small faces get as much as a large one
    of their total area. Only points inside `bounds` come back.
    """
    chosen = np.arange(len(mesh.faces)) if faces is None else np.asarray(faces)
    chosen = chosen if bounds is None else chosen[_touches(mesh.vertices[mesh.faces[chosen]], bounds)]
    corner, second, third = (mesh.vertices[mesh.faces[chosen, k]].astype(np.float64) for k in range(3))
    along, across = second - corner, third - corner
    ends_m2 = np.cumsum(np.linalg.norm(np.cross(along, across), axis=1) / 2)
    count = int(ends_m2[-1] / spacing_m**2) if len(chosen) else 0
    places = np.arange(count) + 0.5
    rows = np.searchsorted(ends_m2, places * spacing_m**2)
    u, v = (places[:, None] * GOLDEN % 1.0).T
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)  # the far half of the square folds back
    points = (corner[rows] + u[:, None] * along[rows] + v[:, None] * across[rows]).astype(np.float32)
    sampled = SurfacePoints(points, mesh.labels[chosen[rows]], chosen[rows].astype(np.int32))
    return sampled if bounds is None else sampled.select(_inside(points, bounds))


def exposed(samples: SurfacePoints, caster: RayCaster) -> NDArray[np.bool_]:
    """Which points (N,) of the static city have air above them: not under another ground layer, not in a building.

    Ground under ground sees the back of a ground face when it looks up; ground in a building sees the back of a
    wall when it looks sideways. Everything else that is hidden is left in: it is little, and true.
    """
    is_open = np.ones(len(samples.points), np.bool_)
    ground = np.flatnonzero(np.isin(samples.labels, GROUND_LABELS))
    start = samples.points[ground] + np.array([0, 0, LIFT_M], np.float32)
    above = _sees_back(caster, start, np.array([0.0, 0.0, 1.0]), GROUND_LABELS, BURIED_M)
    eye = start + np.array([0, 0, 0.3], np.float32)  # 0.3: over grass edges and thresholds, below windowsills
    beside = _sees_back(caster, eye, np.array([1.0, 0.0, 0.0]), [BUILDING], np.inf)
    is_open[ground] = ~(above | beside)
    return is_open


def write_surface_points(path: Path, samples: SurfacePoints) -> None:
    """Write `points` (float32, world metres) and `labels` (Cityscapes) to an .npz."""
    np.savez_compressed(path, points=samples.points, labels=samples.labels)


def read_surface_points(path: Path) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Points (N, 3) and labels (N,) of a file that `write_surface_points` wrote."""
    with np.load(path) as file:
        return file["points"], file["labels"]


def _sees_back(
    caster: RayCaster, points: NDArray, direction: NDArray, labels: list[int], reach_m: float
) -> NDArray[np.bool_]:
    """Where the first thing seen in a direction is the back of a face with one of the labels."""
    hits = caster.cast(points, np.broadcast_to(direction, points.shape))
    is_back = caster.normals[hits.faces] @ direction > 0
    return (hits.distance_m < reach_m) & is_back & np.isin(caster.labels[hits.faces], labels)


def _inside(points: NDArray[np.float32], bounds: Bounds) -> NDArray[np.bool_]:
    return np.all(
        (points >= np.asarray(bounds.low, np.float32)) & (points < np.asarray(bounds.high, np.float32)), axis=1
    )


def _touches(triangles: NDArray[np.float32], bounds: Bounds) -> NDArray[np.bool_]:
    """Which triangles (F, 3, 3) have a bounding box that meets the bounds."""
    low, high = triangles.min(1), triangles.max(1)
    return np.all((high >= np.asarray(bounds.low, np.float32)) & (low < np.asarray(bounds.high, np.float32)), axis=1)
