"""Evenly spread points on the surfaces of a city: ground truth for geometry, and what occupancy is counted from."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from presight_core.classes import CITYSCAPES
from presight_core.synthetic.jit import kernel
from presight_core.synthetic.mesh import Mesh
from presight_core.synthetic.raycast import RayCaster

GROUND_LABELS = [CITYSCAPES.index(name) for name in ("road", "sidewalk", "terrain")]
BUILDING = CITYSCAPES.index("building")
LIFT_M = 0.002  # rays leave a surface from this far above it
EYE_M = 0.3  # over grass edges and thresholds, below windowsills
BURIED_M = 0.5  # the ground's own layers lie closer together than this
CUT_M = 10.0  # triangles wider than this are split before they are clipped
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
    chosen = np.arange(len(mesh.faces), dtype=np.int32) if faces is None else np.asarray(faces, np.int32)
    triangles = mesh.vertices[mesh.faces[chosen]]
    if bounds is not None:
        triangles, chosen = _clip_roughly(triangles, chosen, bounds)
    sides = triangles[:, 1:] - triangles[:, :1]
    ends_m2 = np.cumsum(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2, dtype=np.float64)
    count = int(ends_m2[-1] / spacing_m**2) if len(chosen) else 0
    points, rows = np.empty((count, 3), np.float32), np.empty(count, np.int32)
    _spread(triangles, ends_m2 / spacing_m**2, points, rows)
    faces = chosen[rows]
    sampled = SurfacePoints(points, mesh.labels[faces], faces)
    return sampled if bounds is None else sampled.select(_inside(points, bounds))


def exposed(samples: SurfacePoints, caster: RayCaster) -> NDArray[np.bool_]:
    """Which points (N,) of the static city have air above them: not under another ground layer, not in a building.

    Ground under ground sees the back of a ground face when it looks up; ground in a building sees the back of a
    wall when it looks sideways. Everything else that is hidden is left in: it is little, and true.
    """
    up, sideways = np.array([0, 0, 1], np.float32), np.array([1, 0, 0], np.float32)
    ground = np.flatnonzero(np.isin(samples.labels, GROUND_LABELS))
    is_buried = _sees_back(caster, samples.points[ground] + LIFT_M * up, up, GROUND_LABELS, BURIED_M)
    is_open = np.ones(len(samples.points), np.bool_)
    is_open[ground[is_buried]] = False
    ground = ground[~is_buried]
    is_indoors = _sees_back(caster, samples.points[ground] + EYE_M * up, sideways, [BUILDING], np.inf)
    is_open[ground[is_indoors]] = False
    return is_open


def write_surface_points(path: Path, samples: SurfacePoints) -> None:
    """Write `points` (float32, world metres) and `labels` (Cityscapes) to an .npz."""
    np.savez_compressed(path, points=samples.points, labels=samples.labels)


def read_surface_points(path: Path) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Points (N, 3) and labels (N,) of a file that `write_surface_points` wrote."""
    with np.load(path) as file:
        return file["points"], file["labels"]


@kernel
def _spread(triangles, ends, points, rows):
    """Place a point at every half number on a scale where triangle k ends at `ends[k]`."""
    row = 0
    for n in range(len(points)):
        place = n + 0.5
        while ends[row] < place:
            row += 1
        u, v = place * GOLDEN[0] % 1.0, place * GOLDEN[1] % 1.0
        if u + v > 1:  # the far half of the square folds back
            u, v = 1 - u, 1 - v
        for axis in range(3):
            corner = triangles[row, 0, axis]
            along, across = triangles[row, 1, axis] - corner, triangles[row, 2, axis] - corner
            points[n, axis] = corner + u * along + v * across
        rows[n] = row


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


def _clip_roughly(triangles: NDArray[np.float32], faces: NDArray, bounds: Bounds) -> tuple[NDArray, NDArray]:
    """Triangles (F, 3, 3) and their faces (F,) without what lies outside; large triangles are split to that end."""
    kept = _touches(triangles, bounds)
    triangles, faces = triangles[kept], faces[kept]
    while True:
        is_large = np.ptp(triangles, axis=1).max(1) > CUT_M
        if not is_large.any():
            return np.ascontiguousarray(triangles), faces
        a, b, c = triangles[is_large].swapaxes(0, 1)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        parts = np.stack([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]).transpose(2, 0, 1, 3)  # (F, 4, 3, 3)
        parts, part_faces = parts.reshape(-1, 3, 3), np.repeat(faces[is_large], 4)
        kept = _touches(parts, bounds)
        triangles = np.concatenate([triangles[~is_large], parts[kept]])
        faces = np.concatenate([faces[~is_large], part_faces[kept]])


def _touches(triangles: NDArray[np.float32], bounds: Bounds) -> NDArray[np.bool_]:
    """Which triangles (F, 3, 3) have a bounding box that meets the bounds."""
    low, high = triangles.min(1), triangles.max(1)
    return np.all((high >= np.asarray(bounds.low, np.float32)) & (low < np.asarray(bounds.high, np.float32)), axis=1)
