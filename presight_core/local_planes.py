"""The plane that the surface around each cell of an image lies in, from depths that are roughly known.

1 / depth of a plane is linear in an image's columns and rows, so a plane is a fit of three numbers.
"""

import numba
import numpy as np
from jaxtyping import Float, UInt8
from numpy.typing import NDArray

# Cells to each side that a plane is fitted to, and how far they may lie beside the plane of before, a share of the
# middle cell's nearness. At first that is the plane that faces the camera.
FITS = ((3, 0.15), (5, 0.06), (5, 0.04))
MIN_SHARE = 0.5  # of the known cells of the same label that must lie in a plane
MIN_CELLS = 5


@numba.njit(cache=True)
def planes_around(
    nearness: Float[NDArray, "rows columns"], labels: UInt8[NDArray, "rows columns"]
) -> Float[NDArray, "rows columns 3"]:
    """Planes (a, b, c): 1 / depth is a * column + b * row + c; 0 where the cells around agree on none.

    `nearness` is 1 / depth, 0 where it is unknown. Only cells of the same label count.
    """
    rows, columns = nearness.shape
    planes = np.zeros((rows, columns, 3), np.float32)
    for row in range(rows):
        for column in range(columns):
            if nearness[row, column] > 0:
                _fit(nearness, labels, row, column, planes[row, column])
    return planes


@numba.njit(cache=True)
def _fit(nearness, labels, row, column, plane):
    """Fill the plane of one cell, if there is one."""
    own = nearness[row, column]
    across, down, middle = 0.0, 0.0, float(own)
    for reach, margin in FITS:
        # Of the cells in the plane of before: how many, sums of offsets u and v and of nearness q, and of products.
        n, u1, v1, q1, uu, uv, vv, uq, vq = 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        candidates = 0
        for i in range(max(row - reach, 0), min(row + reach + 1, nearness.shape[0])):
            for j in range(max(column - reach, 0), min(column + reach + 1, nearness.shape[1])):
                q, u, v = nearness[i, j], j - column, i - row
                if q > 0 and labels[i, j] == labels[row, column]:
                    candidates += 1
                    if abs(q - middle - across * u - down * v) < margin * own:
                        n, u1, v1, q1 = n + 1, u1 + u, v1 + v, q1 + q
                        uu, uv, vv, uq, vq = uu + u * u, uv + u * v, vv + v * v, uq + u * q, vq + v * q
        if n < MIN_CELLS or n < MIN_SHARE * candidates:
            return
        uu, uv, vv, uq, vq = uu - u1 * u1 / n, uv - u1 * v1 / n, vv - v1 * v1 / n, uq - u1 * q1 / n, vq - v1 * q1 / n
        determinant = uu * vv - uv * uv
        if determinant < 1:  # all in one line
            return
        across, down = (uq * vv - vq * uv) / determinant, (vq * uu - uq * uv) / determinant
        middle = (q1 - across * u1 - down * v1) / n
    if middle > 0:
        plane[0], plane[1], plane[2] = across, down, middle - across * column - down * row
