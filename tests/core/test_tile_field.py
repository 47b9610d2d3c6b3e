import json

import numpy as np
import pytest
import safetensors.torch
import torch

from presight_core.config import FieldSettings, GridSettings, SamplingSettings
from presight_core.errors import InputError, NotFoundError
from presight_core.field.checkpoint import FIELD_FILE, load_field, load_tensors, save_field, save_tensors
from presight_core.field.surface import find_surface
from presight_core.field.tile_field import FieldShape, Sampling, TileField
from presight_core.tiles import SubField

EAST_M = 600_000.0  # far from the world's origin, as map coordinates may be


def small_shape(sub_field_count: int = 2, channels: int = 5) -> FieldShape:
    """Boxes in a row along x, each 20 m wide, with tiny grids."""
    sub_fields = tuple(
        SubField((EAST_M + 20 * i, 0, 0), (EAST_M + 20 * i - 10, -10, -10), (EAST_M + 20 * i + 10, 10, 10))
        for i in range(sub_field_count)
    )
    grid = GridSettings(levels=3, features_per_level=4, min_resolution=4, max_resolution=16, log2_rows=8)
    proposal = GridSettings(levels=2, features_per_level=1, min_resolution=4, max_resolution=8, log2_rows=8)
    settings = FieldSettings(grid=grid, proposals=(proposal, proposal), hidden_width=8, proposal_width=4)
    sampling = SamplingSettings(near_m=0.5, far_m=200, linear_m=20, proposal_samples=(64, 32), field_samples=32)
    return FieldShape(sub_fields, settings, sampling, channels, video_count=3, image_count=4)


def small_field(**options) -> TileField:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return TileField(small_shape(**options))


def random_rays(count: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    directions = random.normal(size=(count, 3))
    origins = random.uniform(-8, 28, (count, 3)) * (1, 0.2, 0.2) + (EAST_M, 0, 0)
    return origins, directions / np.linalg.norm(directions, axis=-1, keepdims=True)


class Wall(TileField):
    """A field whose density is a thick wall at x = EAST_M + 8 m and beyond."""

    def _density(self, network, points):
        return torch.where(points[..., 0] + self.origin_m[0] > EAST_M + 8, 50.0, 0.0)

    def _ray_density(self, network, rays, edges_m, left, fog):
        density = self._density(network, rays.points(edges_m))
        return torch.where(density < fog, 0, density)


class FoggyWall(Wall):
    """The same, with fog before it in which every other ray would end."""

    fog = 0.1

    def _density(self, network, points):
        return super()._density(network, points).clamp_min(self.fog)


class HazyWall(FoggyWall):
    """With haze in which one of seven rays ends in 8 m."""

    fog = 0.02


def test_rendering_has_a_row_for_each_ray():
    field = small_field()
    seen = field(field.rays(*random_rays(7)))
    assert seen.rgb.shape == (7, 3)
    assert seen.features.shape == (7, 5)
    assert [tuple(proposal.weights.shape) for proposal in seen.proposals] == [(7, 64), (7, 32)]
    assert bool((seen.accumulation <= 1 + 1e-6).all())


def test_a_ray_does_not_depend_on_its_neighbours():
    field = small_field()
    origins, directions = random_rays(9)
    together = field(field.rays(origins, directions))
    alone = field(field.rays(origins[4:5], directions[4:5]))
    torch.testing.assert_close(alone.rgb[0], together.rgb[4], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(alone.features[0], together.features[4], atol=1e-5, rtol=1e-5)


def test_samples_are_answered_by_the_sub_field_they_are_nearest_to():
    field = small_field()
    point = field.rays(np.array([[EAST_M + 21, 1, 1]]), np.array([[1.0, 0, 0]])).origins[:, None]
    before = field.density(point).item()
    with torch.no_grad():
        for bias in field.trunk.network.biases:
            bias[0] += 1
    assert field.density(point).item() == before
    with torch.no_grad():
        field.trunk.network.biases[-1][1] += 1
    assert field.density(point).item() == pytest.approx(before * np.e)


def test_every_parameter_learns():
    field = small_field()
    origins, directions = random_rays(64)
    numbers = np.arange(64)
    rays = field.rays(origins, directions, numbers % 3, numbers % 4)
    seen = field(rays, Sampling(torch.rand(64, 3), 1.0, train_proposals=True))
    loss = seen.rgb.sum() + seen.features.sum() + sum(proposal.weights.square().sum() for proposal in seen.proposals)
    loss.backward()
    idle = [name for name, parameter in field.named_parameters() if parameter.grad is None or not parameter.grad.any()]
    assert idle == []


def test_fading_changes_what_a_field_learns_but_not_what_it_shows():
    field = small_field()
    rays = field.rays(*random_rays(50))
    plain, faded = (field(rays, Sampling(fade_m=fade_m)).rgb for fade_m in (0.0, 1e3))
    assert torch.equal(plain, faded)
    network = next(field.colour.parameters())
    strong, weak = (torch.autograd.grad(rgb.sum(), network)[0].abs().sum() for rgb in (plain, faded))
    assert 0 < weak < strong / 10


def test_features_need_not_decide_where_surfaces_are():
    field = small_field()
    rays = field.rays(*random_rays(50))
    shaping, following = field(rays), field(rays, Sampling(features_shape=False))
    assert torch.equal(shaping.features, following.features)
    pulls = [
        torch.autograd.grad(seen.features.sum(), seen.field.weights, allow_unused=True)[0]
        for seen in (shaping, following)
    ]
    assert pulls[0] is not None
    assert pulls[1] is None
    assert torch.autograd.grad(following.rgb.sum(), following.field.weights)[0].any(), "colours still do"


def test_copies_of_tables_are_read_and_follow_the_tables():
    field, rays = small_field(), random_rays(5)
    exact = field(field.rays(*rays)).rgb
    field.use_copies(torch.bfloat16)
    torch.testing.assert_close(field(field.rays(*rays)).rgb, exact, atol=1e-3, rtol=0)
    with torch.no_grad():
        field.trunk.grid.table.normal_(std=10.0, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(field(field.rays(*rays)).rgb, exact, atol=1e-3, rtol=0)
    field.refresh_copies()
    assert float((field(field.rays(*rays)).rgb - exact).detach().abs().max()) > 0.003
    assert not any("copy" in name for name in field.state_dict())


def test_sky_features_ignore_the_video():
    field = small_field()
    origins, directions = random_rays(5)
    views = []
    for video in (0, 2):
        rays = field.rays(origins, directions, np.full(5, video))
        views.append(field._sky(rays, field.conditions(rays)))
    assert not torch.equal(views[0][0], views[1][0])
    assert torch.equal(views[0][1], views[1][1])


def test_without_a_video_the_mean_embedding_is_used():
    field = small_field()
    origins, directions = random_rays(2)
    unknown = field.conditions(field.rays(origins, directions))
    known = [field.conditions(field.rays(origins, directions, np.full(2, video))) for video in range(3)]
    torch.testing.assert_close(unknown, torch.stack(known).mean(0))


def test_evaluation_is_repeatable_and_training_is_jittered():
    field = small_field()
    rays = field.rays(*random_rays(3))
    assert torch.equal(field(rays).edges_m, field(rays).edges_m)
    assert not torch.equal(field(rays).edges_m, field(rays, Sampling(torch.rand(3, 3))).edges_m)


def test_samples_are_placed_where_depths_are_hinted_at():
    field = small_field()
    rays = field.rays(*random_rays(40))
    hints_m = torch.tensor([7.0, 0.0]).expand(40, -1)  # a depth, and none
    plain, hinted = (field(rays, Sampling(hints_m=hints_m, hint_weight=weight)).edges_m for weight in (0.0, 0.2))
    near = [((edges_m - 7).abs() < 0.5).sum(-1).float().mean() for edges_m in (plain, hinted)]
    assert near[1] > 2 * near[0]
    torch.testing.assert_close(field(rays).edges_m, plain)
    torch.testing.assert_close(field(rays, Sampling(hints_m=torch.zeros(40, 2), hint_weight=0.2)).edges_m, plain)


def test_a_saved_field_renders_the_same(tmp_path):
    field = small_field()
    save_field(tmp_path / "field", field)
    again = load_field(tmp_path / "field")
    rays = random_rays(5)
    assert again.shape == field.shape
    assert torch.equal(again(again.rays(*rays)).rgb, field(field.rays(*rays)).rgb)
    assert json.loads((tmp_path / "field" / "field.json").read_text())["shape"]["feature_channels"] == 5


def test_a_missing_field_says_what_to_do(tmp_path):
    with pytest.raises(NotFoundError, match="train the tile first"):
        load_field(tmp_path)


def test_a_truncated_field_is_refused(tmp_path):
    save_field(tmp_path, small_field())
    file = tmp_path / FIELD_FILE
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(InputError, match="damaged"):
        load_field(tmp_path)


@pytest.mark.parametrize("surface", ["first-hit", "expected", "span"])
def test_surface_lies_on_the_wall(surface):
    wall = Wall(small_shape())
    origin = np.array([[EAST_M + 1, 0.2, 0.1], [EAST_M + 1, 0.2, 0.1]])
    seen = find_surface(wall, origin, np.array([[1.0, 0, 0], [-1.0, 0, 0]]), surface)
    assert seen.found.tolist() == [True, False]
    assert seen.depth_m[0] == pytest.approx(7, abs=0.25)  # the wall begins inside a sample
    np.testing.assert_allclose(seen.points_world[0], origin[0] + [seen.depth_m[0], 0, 0], atol=1e-6)


@pytest.mark.parametrize("surface", ["first-hit", "expected", "span"])
def test_a_ray_goes_through_fog_if_it_is_told_to(surface):
    rays = np.array([[EAST_M - 4, 0.2, 0.1]]), np.array([[1.0, 0, 0]])
    held, through = (find_surface(FoggyWall(small_shape()), *rays, surface, fog_density=fog) for fog in (0, 0.2))
    assert held.depth_m[0] < 9  # half of a ray is left after 7 m of such fog
    assert through.depth_m[0] == pytest.approx(12, abs=0.5)


def test_a_span_begins_and_ends_in_the_wall():
    rays = np.array([[EAST_M + 1, 0.2, 0.1]]), np.array([[1.0, 0, 0]])
    seen = find_surface(Wall(small_shape()), *rays, "span")
    assert seen.found.all()
    begin_m, end_m = seen.depth_m - seen.half_span_m, seen.depth_m + seen.half_span_m
    assert 6.75 < begin_m[0] < end_m[0] < 7.75  # the wall, of 50 per metre, begins inside a sample
    assert not find_surface(Wall(small_shape()), *rays, "first-hit").half_span_m.any()


def test_a_ray_that_has_not_decided_where_it_ends_has_no_span():
    rays = np.array([[EAST_M - 4, 0.2, 0.1]]), np.array([[1.0, 0, 0]])
    undecided, through = (find_surface(FoggyWall(small_shape()), *rays, "span", fog_density=fog) for fog in (0, 0.2))
    assert not undecided.found.any()
    assert through.found.all()


def test_a_ray_of_which_most_ends_on_a_short_way_hits_once_there():
    rays = np.array([[EAST_M, 0.2, 0.1]]), np.array([[1.0, 0, 0]])
    seen = find_surface(HazyWall(small_shape()), *rays, "span")
    assert seen.found.all()
    assert seen.depth_m[0] == pytest.approx(8, abs=0.25)
    assert not seen.half_span_m.any()


def test_surface_density_is_the_mean_of_the_three_networks():
    field, (origins, directions) = small_field(), random_rays(6)
    seen = find_surface(field, origins, directions, "first-hit")
    points = field.rays(seen.points_world, directions).origins[:, None]
    networks = [field.density(points), *field.proposal_densities(points)]
    np.testing.assert_allclose(seen.density, torch.stack(networks).mean(0)[:, 0].detach(), rtol=1e-3)


def test_surface_points_do_not_depend_on_the_chunk(monkeypatch):
    field, rays = small_field(), random_rays(20)
    whole = find_surface(field, *rays, "first-hit")
    monkeypatch.setattr("presight_core.field.surface.CHUNK_RAYS", 6)
    parts = find_surface(field, *rays, "first-hit")
    np.testing.assert_allclose(parts.points_world, whole.points_world, atol=1e-4)
    np.testing.assert_array_equal(parts.found, whole.found)


def test_no_rays_have_no_surface():
    seen = find_surface(small_field(), np.zeros((0, 3)), np.zeros((0, 3)), "first-hit")
    assert seen.features.shape == (0, 5)
    assert seen.points_world.shape == (0, 3)


def test_a_saved_file_is_one_that_safetensors_reads(tmp_path):
    tensors = {"a": torch.arange(6).view(2, 3), "b": torch.rand(3, 2).T, "step": torch.tensor(2.0)}
    save_tensors(tmp_path / "state", tensors, {"step": 2})
    found = safetensors.torch.load_file(tmp_path / "state")
    assert set(found) == set(tensors)
    assert all(torch.equal(found[name], tensors[name]) for name in tensors)
    assert load_tensors(tmp_path / "state")[1] == {"step": 2}
