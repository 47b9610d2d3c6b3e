"""The surface a ray meets, and what the field says there (paper, section 3.3)."""

from dataclasses import dataclass, fields
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from presight_core.field import rendering
from presight_core.field.rays import Rays
from presight_core.field.tile_field import Sampling, TileField

UNSEEN = 1e-3  # share of a ray that is not followed further: at most 1 m of an expected depth, if it went on to 1,000 m
HIT = 0.49  # likewise for the first hit, which is where one half is left; the hundredth is for rounding
CHUNK_RAYS = 32768  # a call costs as much as some 600 rays


@dataclass(frozen=True)
class SurfacePoints:
    """One point for each ray. Where `found` is False the other values mean nothing."""

    found: NDArray[np.bool_]  # (R,) most of the ray's weight lies before the sky
    depth_m: NDArray[np.float32]  # (R,) along the ray
    points_world: NDArray[np.float64]  # (R, 3) metres: origin + depth_m * direction
    features: NDArray[np.float32]  # (R, C) in [0, 1]
    rgb: NDArray[np.float32]  # (R, 3) in [0, 1], at the mean of all embeddings
    density: NDArray[np.float32]  # (R,) per metre, mean of the field and its proposals

    def select(self, chosen: NDArray[np.bool_] | slice) -> "SurfacePoints":
        """Some of the rays."""
        return SurfacePoints(**{column.name: getattr(self, column.name)[chosen] for column in fields(self)})


def find_surface(
    field: TileField,
    origins_world: NDArray[np.float64],
    directions_world: NDArray[np.float64],
    surface: Literal["first-hit", "expected"],
    with_features: bool = True,
    fog_density: float = 0.0,
) -> SurfacePoints:
    """Surface points of rays with world origins (R, 3), metres, and unit directions (R, 3).

    first-hit: where the summed weight passes one half. expected: at the mean depth of the weight. What is thinner than
    `fog_density`, per metre, has no weight.
    Features (of no channel, if they are not wanted), colour and density are those of the field at that very point.
    """
    count = max(1, -(-len(origins_world) // CHUNK_RAYS))
    parts = zip(np.array_split(origins_world, count), np.array_split(directions_world, count), strict=True)
    chunks = [_surface_of_chunk(field, *rays, surface, with_features, fog_density) for rays in parts]
    columns = {
        column.name: np.concatenate([getattr(chunk, column.name) for chunk in chunks])
        for column in fields(SurfacePoints)
    }
    return SurfacePoints(**columns)


@torch.no_grad()
def _surface_of_chunk(
    field: TileField, origins_world: NDArray, directions_world: NDArray, surface: str, with_features: bool, fog: float
) -> SurfacePoints:
    rays = field.rays(origins_world, directions_world)
    depth, found = _depth(field, rays, surface, fog)
    points = (rays.origins + depth[:, None] * rays.directions)[:, None]
    values = field.query(points, field.conditions(rays), with_features)
    density = torch.stack([values.density, *field.proposal_densities(points)]).mean(0)
    depth_m = depth.cpu().numpy()
    return SurfacePoints(
        found.cpu().numpy(),
        depth_m,
        np.asarray(origins_world, np.float64) + depth_m[:, None].astype(np.float64) * directions_world,
        values.features[:, 0].clamp(0, 1).cpu().numpy(),
        values.rgb[:, 0].cpu().numpy(),
        density[:, 0].cpu().numpy(),
    )


def _depth(field: TileField, rays: Rays, surface: str, fog: float) -> tuple[Tensor, Tensor]:
    """Depth (R,) of the surface along each ray, and whether there is one."""
    _, edges = field.place_samples(rays, Sampling(left=UNSEEN))
    edges_m = field.spacing(rays).metres(edges)
    if surface == "expected":
        weights = field.weights(rays, edges_m, UNSEEN, fog)
        _, found = rendering.first_hit(weights)
        return rendering.expected_depth(weights, (edges_m[:, 1:] + edges_m[:, :-1]) / 2), found
    return rendering.first_hit_depth(field.weights(rays, edges_m, HIT, fog), edges_m)
