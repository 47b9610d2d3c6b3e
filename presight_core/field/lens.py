"""How much darker images are towards their corners than in their middles, learned with the field.

Lenses let less light through at their rims, by a factor that is smooth in the square of the distance from the middle
(Goldman, Vignette and exposure calibration and compensation, 2010). A field that knows nothing of it paints surfaces
in the mean of all brightnesses at which images show them. What is raised to a display's curve is still a factor.
"""

from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor, nn

TERMS = 2  # powers of the squared distance

Array = TypeVar("Array", NDArray[np.float64], Tensor)


class LensFalloff(nn.Module):
    """The falloff of each of some cameras: 1 + a r^2 + b r^4, so 1 in the middle. It begins with none."""

    def __init__(self, lens_count: int) -> None:
        super().__init__()
        self.terms = nn.Parameter(torch.zeros(lens_count, TERMS))

    def forward(self, lenses: Int[Tensor, " rays"], off_centre: Float[Tensor, " rays"]) -> Float[Tensor, "rays 1"]:
        """The factor of what each ray shows, by the number of its camera and the `off_centre` of its pixel."""
        powers = torch.stack([off_centre ** (i + 1) for i in range(TERMS)], -1)
        return 1 + (self.terms.index_select(0, lenses) * powers).sum(-1, keepdim=True)


def off_centre(unit: Array, size_px: Array) -> Array:
    """Squared distances (R,) from images' middles, 1 in their corners.

    `unit` (R, 2) are places in the images, x and y in 0..1; `size_px` (R, 2), or (2,) of all, their widths and heights.
    """
    squares: Any = (((unit - 0.5) * size_px) ** 2).sum(-1)
    return 4 * squares / (size_px**2).sum(-1)
