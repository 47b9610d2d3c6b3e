"""The scene representation of a tile (paper, section 3.2).

Sub-fields, each a hash grid with its own small networks, share a sky, two proposal networks' sampling and
the embeddings of videos and images. A sample belongs to the sub-field with the nearest centroid.
"""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor, nn

from presight_core.config import FieldSettings, GridSettings, SamplingSettings
from presight_core.field import ray_density, rendering, samplers
from presight_core.field.assignment import Assignment, assign
from presight_core.field.contraction import grid_position, grid_positions
from presight_core.field.early_stop import weights_until
from presight_core.field.hash_grid import HashGrid
from presight_core.field.lens import LensFalloff
from presight_core.field.mlp import SubFieldMlp
from presight_core.field.rays import Rays
from presight_core.field.spherical_harmonics import HARMONICS, spherical_harmonics
from presight_core.tiles import SubField

SKY_WIDTH = 32  # released code


@dataclass(frozen=True)
class FieldShape:
    """Everything that decides which parameters a field has and how it samples."""

    sub_fields: tuple[SubField, ...]
    settings: FieldSettings
    sampling: SamplingSettings
    feature_channels: int
    video_count: int
    image_count: int
    lens_count: int = 0  # cameras whose falloff is learned, where the settings say so

    def to_json(self) -> dict[str, Any]:
        """The shape as JSON values."""
        return {
            **asdict(self),
            "sub_fields": [sub_field.to_json() for sub_field in self.sub_fields],
            "settings": self.settings.model_dump(mode="json"),
            "sampling": self.sampling.model_dump(mode="json"),
        }

    @staticmethod
    def from_json(value: dict[str, Any]) -> "FieldShape":
        """The shape that `to_json` wrote."""
        sub_fields = tuple(
            SubField(**{name: tuple(corner) for name, corner in sub_field.items()}) for sub_field in value["sub_fields"]
        )
        settings, sampling = FieldSettings(**value["settings"]), SamplingSettings(**value["sampling"])
        names = ("feature_channels", "video_count", "image_count", "lens_count")
        counts = (int(value.get(name, 0)) for name in names)  # fields of before there were lenses have none
        return FieldShape(sub_fields, settings, sampling, *counts)


@dataclass(frozen=True)
class Histogram:
    """Where rays end: weights of the stretches between edges, which are in s (see samplers)."""

    edges: Float[Tensor, "rays edges"]
    weights: Float[Tensor, "rays bins"]


@dataclass(frozen=True)
class Sampling:
    """How samples are placed in one pass, and learn. The default is that of evaluation: nothing random."""

    jitter: Float[Tensor, "rays passes"] | None = None  # in [0, 1), a column for each proposal and the field; or none
    anneal: float | Tensor = 1.0  # exponent of the proposals' weights; below 1 they are flattened
    train_proposals: bool = False
    left: float = 0.0  # a ray is followed until this share of it is left; the proposals' samples beyond weigh nothing
    fade_m: float = 0.0  # samples nearer to the camera than this learn less; see `fade_gradient`
    features_shape: bool = True  # False: density learns nothing from rendered features
    hints_m: Float[Tensor, "rays depths"] | None = None  # where samples go whatever the proposals say; 0: nowhere
    hint_weight: float | Tensor = 0.0  # that each hint adds to the weight, 1 in all at most, of the bin that holds it


@dataclass(frozen=True)
class PointValues:
    """What the field says about points of rays; density per metre, colours and features in 0..1."""

    density: Float[Tensor, "rays samples"]
    rgb: Float[Tensor, "rays samples 3"]
    features: Float[Tensor, "rays samples channels"]

    def faded(self, scale: Float[Tensor, "rays samples"]) -> "PointValues":
        """The same values, whose gradients are multiplied by `scale`."""
        colours, channels = (rendering.fade_gradient(values, scale[..., None]) for values in (self.rgb, self.features))
        return PointValues(rendering.fade_gradient(self.density, scale), colours, channels)


@dataclass(frozen=True)
class Rendering:
    """What rays see."""

    rgb: Float[Tensor, "rays 3"]
    features: Float[Tensor, "rays channels"]
    edges_m: Float[Tensor, "rays edges"]  # of the field's samples
    field: Histogram
    proposals: tuple[Histogram, ...]

    @property
    def accumulation(self) -> Float[Tensor, " rays"]:
        """Share of each ray that ends before the sky."""
        return self.field.weights.sum(-1)


class DensityNetwork(nn.Module):
    """A hash grid and a small network with one density (proposals) or a density and more (the trunk)."""

    def __init__(self, grid: GridSettings, sub_field_count: int, width: int, outputs: int) -> None:
        super().__init__()
        self.grid = HashGrid(grid, sub_field_count)
        self.network = SubFieldMlp(sub_field_count, (self.grid.output_width, width, outputs))

    def forward(self, positions: Tensor, assignment: Assignment, outputs: int | None = None) -> Tensor:
        """The first `outputs` (N, outputs), or all, at positions (N, 3) of the grids, sorted by sub-field."""
        return self.network(self.grid(positions, assignment.segments), assignment, outputs)


class TileField(nn.Module):
    """Density, colour and features everywhere in a tile, and the sky around it."""

    centroids: Tensor
    box_centre: Tensor
    box_half: Tensor

    def __init__(self, shape: FieldShape) -> None:
        super().__init__()
        self.shape = shape
        settings, count, channels = shape.settings, len(shape.sub_fields), shape.feature_channels
        width, geometry = settings.hidden_width, settings.geometry_channels
        self.origin_m = np.mean([sub_field.centroid_m for sub_field in shape.sub_fields], 0)  # world, float64
        self._place_sub_fields()
        self.trunk = DensityNetwork(settings.grid, count, width, 1 + geometry + width)
        video, image = settings.video_embedding, settings.image_embedding
        self.colour = SubFieldMlp(count, (geometry + HARMONICS + video + image, width, width, 3))
        self.semantics = SubFieldMlp(count, (width, width, width, channels))
        self.sky_colour = SubFieldMlp(count, (HARMONICS + video, SKY_WIDTH, SKY_WIDTH, 3))
        self.sky_features = SubFieldMlp(count, (HARMONICS, SKY_WIDTH, SKY_WIDTH, channels))
        self.video_embedding = nn.Embedding(shape.video_count, video)
        self.image_embedding = nn.Embedding(shape.image_count, image)
        self.lenses = LensFalloff(shape.lens_count) if settings.lens_falloff else None
        self.proposals = nn.ModuleList(
            DensityNetwork(grid, count, settings.proposal_width, 1) for grid in settings.proposals
        )

    def _place_sub_fields(self) -> None:
        corners = {
            name: np.array([getattr(sub_field, name) for sub_field in self.shape.sub_fields]) - self.origin_m
            for name in ("centroid_m", "box_min_m", "box_max_m")
        }
        low, high = corners["box_min_m"], corners["box_max_m"]
        for name, value in (
            ("centroids", corners["centroid_m"]),
            ("box_centre", (low + high) / 2),
            ("box_half", (high - low) / 2),
        ):
            self.register_buffer(name, torch.from_numpy(value).float(), persistent=False)

    def use_dtype(self, dtype: torch.dtype) -> None:
        """Let the networks calculate in this type; parameters stay float32."""
        for module in self.modules():
            if isinstance(module, SubFieldMlp):
                module.dtype = dtype

    def use_copies(self, dtype: torch.dtype) -> None:
        """Let the hash grids read rounded copies of their tables; after each step `refresh_copies` renews them."""
        for module in self.modules():
            if isinstance(module, HashGrid):
                module.copy = module.table.detach().to(dtype)

    def refresh_copies(self) -> None:
        """Round the tables again, where there are copies."""
        for module in self.modules():
            if isinstance(module, HashGrid) and module.copy is not None:
                module.copy.copy_(module.table.detach())

    def rays(
        self,
        origins_world: NDArray[np.float64],
        directions_world: NDArray[np.float64],
        videos: NDArray[np.int64] | None = None,
        images: NDArray[np.int64] | None = None,
        lenses: NDArray[np.int64] | None = None,
        off_centre: NDArray[np.float64] | None = None,
    ) -> Rays:
        """Rays of world origins (R, 3), metres, and unit directions (R, 3), on the field's device.

        The origin is subtracted in float64: float32 world coordinates would be wrong by centimetres.
        """
        device = self.centroids.device
        vectors = (
            torch.from_numpy(np.asarray(value, np.float32)).to(device)
            for value in (np.asarray(origins_world, np.float64) - self.origin_m, directions_world)
        )
        numbers = (
            None if value is None else torch.from_numpy(np.asarray(value, np.int64)).to(device)
            for value in (videos, images, lenses)
        )
        places = None if off_centre is None else torch.from_numpy(np.asarray(off_centre, np.float32)).to(device)
        return Rays(*vectors, *numbers, off_centre=places)

    def forward(self, rays: Rays, sampling: Sampling = Sampling()) -> Rendering:
        """Render rays: sample, query, blend, and add the sky behind."""
        conditions = self.conditions(rays)
        proposals, edges = self.place_samples(rays, sampling)
        edges_m = self.spacing(rays).metres(edges)
        values = self.query(rays.points(edges_m), conditions)
        if sampling.fade_m:
            values = values.faded(rendering.share_of_rays(edges_m, sampling.fade_m))
        weights = rendering.ray_weights(values.density, edges_m.diff(dim=-1))
        behind = 1 - weights.sum(-1, keepdim=True)
        sky_rgb, sky_features = self._sky(rays, conditions)
        rgb = rendering.blend(weights, values.rgb) + behind * sky_rgb
        if self.lenses is not None and rays.lenses is not None:
            rgb = rgb * self.lenses(rays.lenses, rays.off_centre)
        shares = (weights, behind) if sampling.features_shape else (weights.detach(), behind.detach())
        return Rendering(
            rgb,
            rendering.blend(shares[0], values.features) + shares[1] * sky_features,
            edges_m,
            Histogram(edges, weights),
            proposals,
        )

    def spacing(self, rays: Rays) -> samplers.Spacing:
        """Where s lies in metres on each ray."""
        settings = self.shape.sampling
        far_m = settings.far_m
        if settings.floor_m is not None:
            far_m = samplers.far_above_floor(rays.directions, far_m, settings.floor_m, settings.floor_slope)
        if rays.ends_m is not None:
            ends_m = rays.ends_m[:, None]
            far_m = torch.minimum(ends_m, far_m) if isinstance(far_m, Tensor) else ends_m.clamp_max(far_m)
        return samplers.Spacing(settings.near_m, far_m, settings.linear_m)

    def place_samples(
        self, rays: Rays, sampling: Sampling
    ) -> tuple[tuple[Histogram, ...], Float[Tensor, "rays edges"]]:
        """Histograms of the proposals, and the edges (in s) of the samples that they ask for."""
        counts = (*self.shape.sampling.proposal_samples, self.shape.sampling.field_samples)
        jitter = [None] * len(counts) if sampling.jitter is None else sampling.jitter.split(1, -1)
        edges = samplers.uniform_edges(len(rays.origins), counts[0], jitter[0], rays.origins)
        histograms, spacing = [], self.spacing(rays)
        proposals = cast("Iterable[DensityNetwork]", self.proposals)
        for number, (proposal, count) in enumerate(zip(proposals, counts[1:], strict=True), 1):
            edges_m = spacing.metres(edges)
            with torch.set_grad_enabled(sampling.train_proposals and torch.is_grad_enabled()):
                weights = self._weights(proposal, rays, edges_m, sampling.left)
            histograms.append(Histogram(edges, weights))
            asked = weights.detach() ** sampling.anneal
            if sampling.hints_m is not None:
                asked = asked + sampling.hint_weight * samplers.held(edges_m, sampling.hints_m)
            edges = samplers.resample(edges, asked, count, jitter[number], self.shape.sampling.padding)
        return tuple(histograms), edges

    def query(
        self, points: Float[Tensor, "rays samples 3"], conditions: Float[Tensor, "rays _"], with_features: bool = True
    ) -> PointValues:
        """Density, colour and features (of no channel, if they are not wanted) at points, with rays' `conditions`."""
        ray_count, sample_count, _ = points.shape
        assignment, positions, inside = self._locate(points)
        geometry = self.shape.settings.geometry_channels
        density, geometry_values, hidden = self.trunk(positions, assignment).split(
            [1, geometry, self.shape.settings.hidden_width], -1
        )
        of_rays = conditions.to(density.dtype).repeat_interleave(sample_count, 0)
        seen = torch.cat([geometry_values, assignment.sort(of_rays)], -1)
        rgb = torch.sigmoid(self.colour(seen, assignment).float())
        features = self.semantics(torch.relu(hidden), assignment) if with_features else hidden[:, :0]
        shape = ray_count, sample_count
        return PointValues(
            assignment.restore(self._activate(density[:, 0], inside)).view(shape),
            assignment.restore(rgb).unflatten(0, shape),
            assignment.restore(features).float().unflatten(0, shape),
        )

    def weights(
        self, rays: Rays, edges_m: Float[Tensor, "rays edges"], left: float = 0.0, fog: float = 0.0
    ) -> Float[Tensor, "rays bins"]:
        """Share of each ray that ends between its edges; nothing beyond where at most `left` of the ray is left.

        Rays go through what is thinner than `fog`, per metre, as if it were nothing.
        """
        return self._weights(self.trunk, rays, edges_m, left, fog)

    def density(self, points: Float[Tensor, "rays samples 3"]) -> Float[Tensor, "rays samples"]:
        """Density per metre at points."""
        return self._density(self.trunk, points)

    def proposal_densities(self, points: Float[Tensor, "rays samples 3"]) -> list[Float[Tensor, "rays samples"]]:
        """Density per metre at points, as each proposal network guesses it."""
        return [self._density(cast("DensityNetwork", proposal), points) for proposal in self.proposals]

    def conditions(self, rays: Rays) -> Float[Tensor, "rays _"]:
        """What colour depends on beside the place: direction, video and image."""
        embeddings = [
            table.weight.mean(0).expand(len(rays.origins), -1)
            if numbers is None
            else table.weight.index_select(0, numbers)
            for table, numbers in ((self.video_embedding, rays.videos), (self.image_embedding, rays.images))
        ]
        return torch.cat([spherical_harmonics(rays.directions), *embeddings], -1)

    def _weights(self, network: DensityNetwork, rays: Rays, edges_m: Tensor, left: float, fog: float = 0.0) -> Tensor:
        if ray_density.suits(network.grid, edges_m):
            density = self._ray_density(network, rays, edges_m, left, fog)
            return rendering.ray_weights(density, edges_m.diff(dim=-1))
        if left:
            return weights_until(lambda points: self._density(network, points), rays, edges_m, left, fog)
        return rendering.ray_weights(self._density(network, rays.points(edges_m)), edges_m.diff(dim=-1))

    def _ray_density(
        self, network: DensityNetwork, rays: Rays, edges_m: Tensor, left: float, fog: float = 0.0
    ) -> Tensor:
        boxes, bias = (self.centroids, self.box_centre, self.box_half), self.shape.settings.density_bias
        return ray_density.ray_density(network.grid, network.network, boxes, rays, edges_m, bias, left, fog)

    def _density(self, network: DensityNetwork, points: Tensor) -> Tensor:
        if ray_density.suits(network.grid, points):
            starts = points.reshape(-1, 3)  # of rays without length
            rays, edges_m = Rays(starts, torch.zeros_like(starts)), starts.new_zeros(len(starts), 2)
            return self._ray_density(network, rays, edges_m, 0.0).view(points.shape[:-1])
        assignment, positions, inside = self._locate(points)
        density = network(positions, assignment, 1)[:, 0]
        return assignment.restore(self._activate(density, inside)).view(points.shape[:-1])

    def _activate(self, output: Tensor, inside: Tensor) -> Tensor:
        """Density per metre of a network's output; nothing is beyond the grid."""
        density = rendering.truncated_exponential(output.float() + self.shape.settings.density_bias)
        return density * inside

    def _locate(self, points: Tensor) -> tuple[Assignment, Tensor, Tensor]:
        """The sorting by sub-field of points (..., 3), their grid positions (N, 3), and which have one."""
        flat = points.reshape(-1, 3)
        assignment = assign(flat, self.centroids)
        if points.device.type == "cpu" and not points.requires_grad:
            boxes = assignment.segments, self.box_centre, self.box_half
            return assignment, *grid_positions(assignment.sort(flat), *boxes)
        centre, half = assignment.spread(self.box_centre), assignment.spread(self.box_half)
        positions, inside = grid_position(assignment.sort(flat), centre, half)
        return assignment, positions, inside

    def _sky(self, rays: Rays, conditions: Tensor) -> tuple[Tensor, Tensor]:
        """Colour (R, 3) and features (R, C) of the sky; the features ignore the video."""
        assignment = assign(rays.origins, self.centroids)
        seen = assignment.sort(conditions[:, : HARMONICS + self.shape.settings.video_embedding])
        rgb = torch.sigmoid(self.sky_colour(seen, assignment).float())
        features = self.sky_features(seen[:, :HARMONICS], assignment).float()
        return assignment.restore(rgb), assignment.restore(features)
