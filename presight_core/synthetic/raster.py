"""Rasterisation into a visibility buffer: which face each sample sees, and how near it is.

Buffers hold `nearness` (larger is closer; 1 / depth for cameras, height along the light for shadows) and the face
index, -1 where nothing is seen. Sample (row, column) lies at integer sample coordinates (column, row).
"""

# ruff: noqa: PLR0913, PLR0917 - kernels take plain numbers and leave early

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from presight_core.synthetic.jit import inner, kernel
from presight_core.synthetic.mesh import Mesh

EDGE_TOLERANCE = 1e-6  # samples; neighbours overlap by this much rather than leave a crack


class PinholeView(NamedTuple):
    """A camera in sample coordinates."""

    focal_x: float
    focal_y: float
    centre_x: float
    centre_y: float
    camera_from_world: NDArray[np.float64]  # (3, 3) rotation
    position: NDArray[np.float64]  # (3,) world
    near_m: float
    far_m: float


@inner
def draw_triangle(x0, y0, n0, x1, y1, n1, x2, y2, n2, face, nearness, faces):
    """Fill one triangle given by sample coordinates and nearness at its corners."""
    height, width = nearness.shape
    area = (x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0)
    if abs(area) < 1e-12:  # seen edge-on
        return
    first_row = max(0, int(np.ceil(min(y0, y1, y2) - EDGE_TOLERANCE)))
    last_row = min(height - 1, int(np.floor(max(y0, y1, y2) + EDGE_TOLERANCE)))
    slope_x = ((n1 - n0) * (y2 - y0) - (n2 - n0) * (y1 - y0)) / area
    slope_y = ((n2 - n0) * (x1 - x0) - (n1 - n0) * (x2 - x0)) / area
    nearest = max(n0, n1, n2)  # extrapolation into the tolerance must not beat the triangle's own corners
    for row in range(first_row, last_row + 1):
        low, high = span(x0, y0, x1, y1, x2, y2, row)
        first = max(0, int(np.ceil(low - EDGE_TOLERANCE)))
        last = min(width - 1, int(np.floor(high + EDGE_TOLERANCE)))
        start = n0 + slope_y * (row - y0) - slope_x * x0
        for column in range(first, last + 1):
            near = min(start + slope_x * column, nearest)
            if near > nearness[row, column]:
                nearness[row, column] = near
                faces[row, column] = face


@inner
def span(x0, y0, x1, y1, x2, y2, row):
    """The interval of x that the triangle covers on one row."""
    low, high = np.inf, -np.inf
    low, high = widen_span(x0, y0, x1, y1, row, low, high)
    low, high = widen_span(x1, y1, x2, y2, row, low, high)
    return widen_span(x2, y2, x0, y0, row, low, high)


@inner
def widen_span(xa, ya, xb, yb, row, low, high):
    """`low` and `high` with the crossing of one edge and the row added, if they meet."""
    if min(ya, yb) - EDGE_TOLERANCE > row or max(ya, yb) + EDGE_TOLERANCE < row:
        return low, high
    if abs(yb - ya) < 1e-9:  # the edge lies along the row
        return min(low, xa, xb), max(high, xa, xb)
    t = min(max((row - ya) / (yb - ya), 0.0), 1.0)
    x = xa + t * (xb - xa)
    return min(low, x), max(high, x)


@kernel
def draw_perspective(mesh: Mesh, view: PinholeView, first_face: int, nearness, faces):
    """Draw a mesh as a camera sees it; `first_face` is added to its face indices."""
    width = nearness.shape[1]
    slope_left = view.centre_x / view.focal_x
    slope_right = (width - view.centre_x) / view.focal_x
    reach_left, reach_right = np.sqrt(1 + slope_left**2), np.sqrt(1 + slope_right**2)
    r, c = view.camera_from_world, view.position
    corners, clipped = np.empty((3, 3)), np.empty((4, 3))
    for chunk in range(len(mesh.chunks)):
        sphere = mesh.spheres[chunk]
        dx, dy, dz = sphere[0] - c[0], sphere[1] - c[1], sphere[2] - c[2]
        x = r[0, 0] * dx + r[0, 1] * dy + r[0, 2] * dz
        z = r[2, 0] * dx + r[2, 1] * dy + r[2, 2] * dz
        radius = sphere[3]
        if z < view.near_m - radius or z > view.far_m + radius:
            continue
        if -x - slope_left * z > radius * reach_left or x - slope_right * z > radius * reach_right:
            continue
        for face in range(mesh.chunks[chunk, 0], mesh.chunks[chunk, 1]):
            in_front = 0
            for k in range(3):
                vertex = mesh.faces[face, k]
                dx = mesh.vertices[vertex, 0] - c[0]
                dy = mesh.vertices[vertex, 1] - c[1]
                dz = mesh.vertices[vertex, 2] - c[2]
                for axis in range(3):
                    corners[k, axis] = r[axis, 0] * dx + r[axis, 1] * dy + r[axis, 2] * dz
                in_front += corners[k, 2] >= view.near_m
            if in_front > 0:
                draw_clipped(corners, clipped, view, face + first_face, nearness, faces)


@inner
def draw_clipped(corners, clipped, view, face, nearness, faces):
    """Cut a triangle in camera coordinates at the near plane, project and draw it."""
    count = 0
    for k in range(3):
        following = (k + 1) % 3
        depth, next_depth = corners[k, 2], corners[following, 2]
        if depth >= view.near_m:
            for axis in range(3):
                clipped[count, axis] = corners[k, axis]
            count += 1
        if (depth >= view.near_m) != (next_depth >= view.near_m):
            t = (view.near_m - depth) / (next_depth - depth)
            for axis in range(3):
                clipped[count, axis] = corners[k, axis] + t * (corners[following, axis] - corners[k, axis])
            count += 1
    for k in range(count):
        near = 1.0 / clipped[k, 2]
        clipped[k, 0] = clipped[k, 0] * near * view.focal_x + view.centre_x
        clipped[k, 1] = clipped[k, 1] * near * view.focal_y + view.centre_y
        clipped[k, 2] = near
    p = clipped
    for k in range(1, count - 1):
        draw_triangle(
            p[0, 0], p[0, 1], p[0, 2], p[k, 0], p[k, 1], p[k, 2], p[k + 1, 0], p[k + 1, 1], p[k + 1, 2],
            face, nearness, faces,
        )  # fmt: skip


@kernel
def draw_orthographic(mesh: Mesh, axes, origin, sample_m: float, nearness, faces):
    """Draw a mesh as parallel light sees it.

    `axes` (3, 3): rows u, v and the direction to the light; sample = (axes[:2] @ point - origin) / sample_m.
    """
    height, width = nearness.shape
    p = np.empty((3, 3))
    for chunk in range(len(mesh.chunks)):
        sphere = mesh.spheres[chunk]
        u = (axes[0, 0] * sphere[0] + axes[0, 1] * sphere[1] + axes[0, 2] * sphere[2] - origin[0]) / sample_m
        v = (axes[1, 0] * sphere[0] + axes[1, 1] * sphere[1] + axes[1, 2] * sphere[2] - origin[1]) / sample_m
        radius = sphere[3] / sample_m
        if u < -radius or v < -radius or u > width + radius or v > height + radius:
            continue
        for face in range(mesh.chunks[chunk, 0], mesh.chunks[chunk, 1]):
            for k in range(3):
                vertex = mesh.faces[face, k]
                x, y, z = mesh.vertices[vertex, 0], mesh.vertices[vertex, 1], mesh.vertices[vertex, 2]
                p[k, 0] = (axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z - origin[0]) / sample_m
                p[k, 1] = (axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z - origin[1]) / sample_m
                p[k, 2] = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z
            draw_triangle(
                p[0, 0], p[0, 1], p[0, 2], p[1, 0], p[1, 1], p[1, 2], p[2, 0], p[2, 1], p[2, 2],
                face, nearness, faces,
            )  # fmt: skip
