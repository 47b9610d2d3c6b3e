"""Rays in the field frame."""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Rays:
    """Rays in the field frame. Without videos or images the mean of all their embeddings is used."""

    origins: Float[Tensor, "rays 3"]
    directions: Float[Tensor, "rays 3"]  # unit length
    videos: Int[Tensor, " rays"] | None = None
    images: Int[Tensor, " rays"] | None = None
    lenses: Int[Tensor, " rays"] | None = None  # that took the images; None: colours as in the images' middles
    off_centre: Float[Tensor, " rays"] | None = None  # of the pixels, where there are lenses; see `lens`
    ends_m: Float[Tensor, " rays"] | None = None  # nothing lies beyond; None or inf: the far plane

    def points(self, edges_m: Float[Tensor, "rays edges"]) -> Float[Tensor, "rays samples 3"]:
        """The middle of each stretch between two edges."""
        middles = (edges_m[:, 1:] + edges_m[:, :-1]) / 2
        return self.origins[:, None] + middles[..., None] * self.directions[:, None]
