"""Everything that is not part of the city: road users, and what roadworks put on a street."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from presight_core.synthetic.actor_shapes import KINDS, template
from presight_core.synthetic.mesh import Mesh, face_normals

FIRST_ACTOR = 1_000_000  # instance numbers from here on are actors, below are parts of the city
FOOT_M = 0.02  # wheels and shoes stand this far above the ground, so that they never sink into its triangles

Motion = Literal["moving", "stopped", "parked"]


@dataclass(frozen=True)
class Actor:
    """One road user or thing at one moment."""

    kind: str  # a key of KINDS
    x_m: float
    y_m: float
    yaw_rad: float
    colour: tuple[float, float, float]
    instance: int  # FIRST_ACTOR or more
    ground_m: float = 0.0  # height of the road or sidewalk under it
    motion: Motion = "parked"  # stopped: stands now, but moves at other times


def actor_mesh(actors: Sequence[Actor]) -> Mesh:
    """One mesh of all actors at their places; an empty mesh for none."""
    parts = [_placed(actor) for actor in actors]
    if not parts:
        return _empty_mesh()
    starts = np.cumsum([0] + [len(part[0]) for part in parts[:-1]])
    vertices = np.concatenate([part[0] for part in parts]).astype(np.float32)
    faces = np.concatenate([part[1] + start for part, start in zip(parts, starts, strict=True)]).astype(np.int32)
    counts = np.array([len(part[1]) for part in parts])
    ends = np.cumsum(counts)
    centres = np.array([[a.x_m, a.y_m, a.ground_m + KINDS[a.kind].height_m / 2] for a in actors])
    radii = [[np.linalg.norm([KINDS[a.kind].length_m, KINDS[a.kind].width_m, 4]) / 2 + 0.3] for a in actors]
    return Mesh(
        vertices=vertices,
        faces=faces,
        normals=face_normals(vertices, faces),
        colours=np.concatenate([part[2] for part in parts]).astype(np.float32),
        walls=np.zeros((len(faces), 5), np.float32),
        materials=np.concatenate([part[3] for part in parts]),
        labels=np.concatenate([part[4] for part in parts]),
        instances=np.repeat(np.array([actor.instance for actor in actors], np.int32), counts),
        chunks=np.stack([ends - counts, ends], -1).astype(np.int64),
        spheres=np.concatenate([centres, radii], 1).astype(np.float32),
    )


def foot_of(actor: Actor) -> NDArray[np.float64]:
    """Where an actor stands (3,), world metres."""
    return np.array([actor.x_m, actor.y_m, actor.ground_m + FOOT_M])


def _placed(actor: Actor) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray]:
    """Vertices in the world, faces, colours, materials and labels of one actor."""
    vertices, faces, materials, labels, colours, tints = template(actor.kind)
    c, s = np.cos(actor.yaw_rad), np.sin(actor.yaw_rad)
    placed = vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + foot_of(actor)
    return placed, faces, colours + tints * np.array(actor.colour), materials, labels


def _empty_mesh() -> Mesh:
    return Mesh(
        np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32),
        np.zeros((0, 3), np.float32), np.zeros((0, 5), np.float32), np.zeros(0, np.uint8), np.zeros(0, np.uint8),
        np.zeros(0, np.int32), np.zeros((0, 2), np.int64), np.zeros((0, 4), np.float32),
    )  # fmt: skip
