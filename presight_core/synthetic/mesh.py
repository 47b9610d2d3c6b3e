"""Triangle meshes: named arrays, a builder, and the few solids a city is made of."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from presight_core.synthetic.materials import LABEL_OF_MATERIAL, Material


class Mesh(NamedTuple):
    """A triangle soup, world metres. Faces of one chunk are neighbours, so that whole chunks can be culled."""

    vertices: NDArray[np.float32]  # (V, 3)
    faces: NDArray[np.int32]  # (F, 3)
    normals: NDArray[np.float32]  # (F, 3) unit
    colours: NDArray[np.float32]  # (F, 3) linear reflectance in 0..1
    walls: NDArray[np.float32]  # (F, 5) facades: a Wall each
    materials: NDArray[np.uint8]  # (F,) Material
    labels: NDArray[np.uint8]  # (F,) Cityscapes train id
    instances: NDArray[np.int32]  # (F,) 0: no single object
    chunks: NDArray[np.int64]  # (C, 2) first face, one past the last
    spheres: NDArray[np.float32]  # (C, 4) bounding sphere: centre, radius


class Wall(NamedTuple):
    """Where a facade's windows go: the wall's start along its horizontal tangent, width, foot and height in metres.

    `pattern` is a texture seed times four, plus 2 for brick courses, plus 1 for shop windows on the ground floor.
    """

    start_m: float = 0.0
    width_m: float = 1.0
    foot_m: float = 0.0
    height_m: float = 1.0
    pattern: float = 0.0


class Surface(NamedTuple):
    """What all faces of one solid share."""

    material: Material
    colour: ArrayLike  # (3,)
    instance: int = 0
    label: int | None = None  # None: the material's own class
    wall: Wall = Wall()


class MeshBuilder:
    """Collects solids and joins them into one Mesh."""

    def __init__(self) -> None:
        self._vertices: list[NDArray[np.float32]] = []
        self._faces: list[NDArray[np.int32]] = []
        self._surfaces: list[tuple[int, Surface]] = []
        self._vertex_count = 0

    def add(self, vertices: ArrayLike, faces: ArrayLike, surface: Surface) -> None:
        """Append vertices (N, 3) and faces (K, 3) that index them."""
        vertices, faces = np.asarray(vertices, np.float32), np.asarray(faces, np.int32)
        if len(faces) == 0:
            return
        self._vertices.append(vertices)
        self._faces.append(faces + np.int32(self._vertex_count))
        self._surfaces.append((len(faces), surface))
        self._vertex_count += len(vertices)

    def build(self, chunk_m: float | None = None) -> Mesh:
        """The mesh of everything added; `chunk_m` sorts faces into square columns of that size."""
        vertices, faces = np.concatenate(self._vertices), np.concatenate(self._faces)
        counts = [count for count, _ in self._surfaces]

        def per_face(values: list, dtype: type) -> NDArray:
            return np.repeat(np.array(values, dtype), counts, axis=0)

        surfaces = [surface for _, surface in self._surfaces]
        labels = [LABEL_OF_MATERIAL[s.material] if s.label is None else s.label for s in surfaces]
        mesh = Mesh(
            vertices=vertices,
            faces=faces,
            normals=face_normals(vertices, faces),
            colours=per_face([s.colour for s in surfaces], np.float32),
            walls=per_face([s.wall for s in surfaces], np.float32),
            materials=per_face([s.material for s in surfaces], np.uint8),
            labels=per_face(labels, np.uint8),
            instances=per_face([s.instance for s in surfaces], np.int32),
            chunks=np.array([[0, len(faces)]], np.int64),
            spheres=_bounding_spheres(vertices[faces], np.array([0])),
        )
        return mesh if chunk_m is None else _sorted_by_chunk(mesh, chunk_m)


def face_normals(vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> NDArray[np.float32]:
    """Unit normals (F, 3), counter-clockwise faces pointing at the viewer."""
    corner, second, third = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    normals = np.cross(second - corner, third - corner)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return (normals / np.maximum(lengths, 1e-12)).astype(np.float32)  # 1e-12: a face without area has no normal


def _sorted_by_chunk(mesh: Mesh, chunk_m: float) -> Mesh:
    centres = mesh.vertices[mesh.faces].mean(1)
    cells = np.floor(centres[:, :2] / chunk_m).astype(np.int64)
    keys = cells[:, 0] * 2**32 + cells[:, 1]
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    starts = np.flatnonzero(np.r_[True, keys[1:] != keys[:-1]])
    per_face = ("faces", "normals", "colours", "walls", "materials", "labels", "instances")
    mesh = mesh._replace(**{name: np.ascontiguousarray(getattr(mesh, name)[order]) for name in per_face})
    chunks = np.stack([starts, np.r_[starts[1:], len(keys)]], -1).astype(np.int64)
    return mesh._replace(chunks=chunks, spheres=_bounding_spheres(mesh.vertices[mesh.faces], starts))


def _bounding_spheres(triangles: NDArray[np.float32], starts: NDArray[np.int64]) -> NDArray[np.float32]:
    low = np.minimum.reduceat(triangles.min(1), starts)
    high = np.maximum.reduceat(triangles.max(1), starts)
    radius = np.linalg.norm(high - low, axis=1, keepdims=True) / 2
    return np.concatenate([(low + high) / 2, radius], 1).astype(np.float32)


# ---- solids: vertices and faces around the origin, or at a place -------------------------------------------------

BOX_FACES = np.array(
    [[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4],
     [1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7]]
)  # fmt: skip
BOX_TOP = BOX_FACES[2:4]
BOX_SIDES = BOX_FACES[4:]  # two faces a side: front (-y), right, back, left


class Box(NamedTuple):
    """An upright box: foot centre (x, y, z), length along `yaw_rad`, width, height; `taper` shrinks its top."""

    x: float
    y: float
    z: float
    length: float
    width: float
    height: float
    yaw_rad: float = 0.0
    taper: float = 1.0

    def vertices(self) -> NDArray[np.float64]:
        """Corners (8, 3): the foot counter-clockwise from the rear right, then the top."""
        corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * [self.length, self.width]
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        turned = corners @ np.array([[c, s], [-s, c]])
        foot = np.c_[turned + np.array([self.x, self.y]), np.full(4, self.z)]
        top = np.c_[turned * self.taper + np.array([self.x, self.y]), np.full(4, self.z + self.height)]
        return np.concatenate([foot, top])


def cylinder(sides: int = 6) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """A closed upright cylinder of radius 1 and height 1 on the origin, without a bottom."""
    angles = np.arange(sides) * 2 * np.pi / sides
    ring = np.c_[np.cos(angles), np.sin(angles)]
    vertices = np.r_[np.c_[ring, np.zeros(sides)], np.c_[ring, np.ones(sides)], [[0, 0, 1]]]
    i = np.arange(sides)
    j = (i + 1) % sides
    top = np.full(sides, 2 * sides)
    faces = np.r_[np.c_[i, j, j + sides], np.c_[i, j + sides, i + sides], np.c_[i + sides, j + sides, top]]
    return vertices, faces


def sphere(subdivisions: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """An icosahedron split `subdivisions` times, vertices on the unit sphere."""
    t = (1 + 5**0.5) / 2  # golden ratio
    corners = [(-1, t, 0), (1, t, 0), (-1, -t, 0), (1, -t, 0), (0, -1, t), (0, 1, t),
               (0, -1, -t), (0, 1, -t), (t, 0, -1), (t, 0, 1), (-t, 0, -1), (-t, 0, 1)]  # fmt: skip
    faces = np.array(
        [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6),
         (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10),
         (8, 6, 7), (9, 8, 1)]
    )  # fmt: skip
    vertices = np.array(corners, np.float64) / np.hypot(1, t)
    for _ in range(subdivisions):
        vertices, faces = _split_faces(vertices, faces)
    return vertices, faces


def _split_faces(vertices: NDArray[np.float64], faces: NDArray) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Every face in four, the new corners pushed out to the sphere."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    middles = vertices[unique].mean(1)
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    ab, bc, ca = (len(vertices) + inverse.reshape(3, -1)).astype(np.int64)
    a, b, c = faces.T
    split = np.concatenate([np.c_[a, ab, ca], np.c_[b, bc, ab], np.c_[c, ca, bc], np.c_[ab, bc, ca]])
    return np.concatenate([vertices, middles]), split
