"""The surface a ray meets, and what the field says there (paper, section 3.3)."""

from dataclasses import dataclass, fields

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from presight_core.config import SurfaceRule
from presight_core.field import rendering
from presight_core.field.rays import Rays
from presight_core.field.tile_field import Sampling, TileField

UNSEEN = 1e-3  # share of a ray that is not followed further: at most 1 m of an expected depth, if it went on to 1,000 m
ROUNDING = 0.01  # of a ray is followed beyond what is looked for
HIT = 0.5  # of a ray's weight, where it hits first
SPAN = (0.05, 0.95)  # of a ray's weight, where a surface begins and where it ends
CORE = (0.2, 0.8)  # of a ray's weight: the most of it
MAX_LENGTH = 0.1  # of the way to where they begin, of both
CHUNK_RAYS = 32768  # a call costs as much as some 600 rays


@dataclass(frozen=True)
class SurfacePoints:
    """One point for each ray. Where `found` is False the other values mean nothing."""

    found: NDArray[np.bool_]  # (R,) most of the ray's weight lies before the sky, and is not spread too far
    depth_m: NDArray[np.float32]  # (R,) along the ray
    points_world: NDArray[np.float64]  # (R, 3) metres: origin + depth_m * direction
    features: NDArray[np.float32]  # (R, C) in [0, 1]
    rgb: NDArray[np.float32]  # (R, 3) in [0, 1], at the mean of all embeddings
    density: NDArray[np.float32]  # (R,) per metre, mean of the field and its proposals
    half_span_m: NDArray[np.float32]  # (R,) how far before the point the surface begins, and behind it ends

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.int64] | slice) -> "SurfacePoints":
        """Some of the rays."""
        return SurfacePoints(**{column.name: getattr(self, column.name)[chosen] for column in fields(self)})


def find_surface(
    field: TileField,
    origins_world: NDArray[np.float64],
    directions_world: NDArray[np.float64],
    surface: SurfaceRule,
    with_features: bool = True,
    fog_density: float = 0.0,
) -> SurfacePoints:
    """Surface points of rays with world origins (R, 3), metres, and unit directions (R, 3).

    first-hit: where the summed weight passes one half. expected: at the mean depth of the weight. span: in the middle
    between where it passes SPAN, the only rule with a `half_span_m`; if that is too long, at the first hit, and nowhere
    if even CORE is. What is thinner than `fog_density`, per metre, has no weight.
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
    field: TileField, origins_world: NDArray, directions: NDArray, rule: SurfaceRule, with_features: bool, fog: float
) -> SurfacePoints:
    rays = field.rays(origins_world, directions)
    depth, half_span, found = _depth(field, rays, rule, fog)
    points = (rays.origins + depth[:, None] * rays.directions)[:, None]
    values = field.query(points, field.conditions(rays), with_features)
    density = torch.stack([values.density, *field.proposal_densities(points)]).mean(0)
    depth_m = depth.cpu().numpy()
    return SurfacePoints(
        found.cpu().numpy(),
        depth_m,
        np.asarray(origins_world, np.float64) + depth_m[:, None].astype(np.float64) * directions,
        values.features[:, 0].clamp(0, 1).cpu().numpy(),
        values.rgb[:, 0].cpu().numpy(),
        density[:, 0].cpu().numpy(),
        half_span.cpu().numpy(),
    )


def _depth(field: TileField, rays: Rays, rule: SurfaceRule, fog: float) -> tuple[Tensor, Tensor, Tensor]:
    """Depth (R,) of the surface along each ray, half of its span, and whether there is one."""
    _, edges = field.place_samples(rays, Sampling(left=UNSEEN))
    edges_m = field.spacing(rays).metres(edges)
    if rule == "expected":
        weights = field.weights(rays, edges_m, UNSEEN, fog)
        _, found = rendering.first_hit(weights, HIT)
        depth = rendering.expected_depth(weights, (edges_m[:, 1:] + edges_m[:, :-1]) / 2)
        return depth, torch.zeros_like(depth), found
    weights = field.weights(rays, edges_m, 1 - (SPAN[1] if rule == "span" else HIT) - ROUNDING, fog)
    hit, found = rendering.first_hit_depth(weights, edges_m, HIT)
    if rule == "first-hit":
        return hit, torch.zeros_like(hit), found
    begin, end, has_span = _stretch(weights, edges_m, SPAN)
    *_, has_core = _stretch(weights, edges_m, CORE)
    return torch.where(has_span, (begin + end) / 2, hit), torch.where(has_span, (end - begin) / 2, 0), has_core


def _stretch(weights: Tensor, edges_m: Tensor, shares: tuple[float, float]) -> tuple[Tensor, Tensor, Tensor]:
    """Depths (R,) at which the weight passes two shares, and whether it passes both within a short way."""
    (begin, _), (end, is_passed) = (rendering.first_hit_depth(weights, edges_m, share) for share in shares)
    return begin, end, is_passed & (end <= (1 + MAX_LENGTH) * begin)
