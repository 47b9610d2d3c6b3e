"""All of space, squeezed into the unit cube that a hash grid covers."""

import torch
from jaxtyping import Bool, Float
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
