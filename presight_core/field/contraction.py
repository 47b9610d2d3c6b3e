"""All of space, squeezed into the unit cube that a hash grid covers."""

import numba
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numba import prange
from torch import Tensor


def contract(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Squeeze all of space into a cube of half-width 2; the cube of half-width 1 stays put.

    The infinity-norm form of mip-NeRF 360, equation 10: hash grids are cubes, and a ball would leave
    their corners empty.
    """
    norm = points.abs().amax(-1, keepdim=True).clamp_min(1)  # inside, the factor below is exactly 1
    return points * ((2 - 1 / norm) / norm)


def grid_position(
    points_field: Float[Tensor, "*batch 3"], centre: Float[Tensor, "*#batch 3"], half_size: Float[Tensor, "*#batch 3"]
) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
    """Positions in [0, 1) of points around a box, and which of them the grid can tell apart.

    Points so far away that float32 puts them on the cube's surface are False, and moved to the origin.
    """
    unit = (contract((points_field - centre) / half_size) + 2) / 4
    inside = ((unit > 0) & (unit < 1)).all(-1)
    return torch.where(inside[..., None], unit, 0), inside


def grid_positions(
    points_field: Float[Tensor, "points 3"],
    segments: Int[Tensor, " sub_fields+1"],
    centres: Float[Tensor, "sub_fields 3"],
    half_sizes: Float[Tensor, "sub_fields 3"],
) -> tuple[Float[Tensor, "points 3"], Bool[Tensor, " points"]]:
    """`grid_position` of points sorted by sub-field, in one pass on a CPU; no gradient reaches the points."""
    positions = torch.empty_like(points_field)
    inside = torch.empty(len(points_field), dtype=torch.bool)
    tensors = (points_field.detach().contiguous(), segments, centres, half_sizes, positions, inside)
    _fill_positions(*(tensor.numpy() for tensor in tensors))
    return positions, inside


@numba.njit(parallel=True, cache=True, error_model="numpy")
def _fill_positions(points, segments, centres, half_sizes, positions, inside):
    one, two, quarter = np.float32(1), np.float32(2), np.float32(0.25)
    for sub_field in range(len(centres)):
        centre, half = centres[sub_field], half_sizes[sub_field]
        for i in prange(segments[sub_field], segments[sub_field + 1]):
            x = (points[i, 0] - centre[0]) / half[0]
            y = (points[i, 1] - centre[1]) / half[1]
            z = (points[i, 2] - centre[2]) / half[2]
            norm = max(abs(x), abs(y), abs(z), one)
            factor = (two - one / norm) / norm
            x, y, z = (x * factor + two) * quarter, (y * factor + two) * quarter, (z * factor + two) * quarter
            within = min(x, y, z) > 0 and max(x, y, z) < one
            inside[i] = within
            positions[i, 0] = x if within else 0
            positions[i, 1] = y if within else 0
            positions[i, 2] = z if within else 0
