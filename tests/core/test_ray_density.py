import numpy as np
import pytest
import torch

from presight_core.config import FieldSettings, GridSettings, SamplingSettings
from presight_core.field import ray_density, threads
from presight_core.field.early_stop import weights_until
from presight_core.field.rendering import ray_weights
from presight_core.field.tile_field import FieldShape, TileField
from presight_core.tiles import SubField

RAYS = 300
HIDDEN = 20  # not a multiple of the kernel's lanes


def field_of(sub_field_count: int, features: int = 1, levels: int = 3) -> TileField:
    """Sub-fields in a row along x, whose tables and networks hold large random numbers: density varies a lot."""
    sub_fields = tuple(
        SubField((20.0 * i, 0, 0), (20.0 * i - 10, -10, -10), (20.0 * i + 10, 10, 10)) for i in range(sub_field_count)
    )
    grid = GridSettings(levels=levels, features_per_level=features, min_resolution=4, max_resolution=64, log2_rows=10)
    settings = FieldSettings(grid=grid, proposals=(grid,), hidden_width=HIDDEN, proposal_width=HIDDEN)
    sampling = SamplingSettings(near_m=0.5, far_m=200, linear_m=20, proposal_samples=(32,), field_samples=32)
    torch.manual_seed(0)
    field = TileField(FieldShape(sub_fields, settings, sampling, 5, 1, 1))
    for network in (field.trunk, *field.proposals):
        torch.nn.init.uniform_(network.grid.table, -9, 9)
    return field


def rays_and_edges(field: TileField, bins: int = 32, count: int = RAYS):
    random = np.random.default_rng(0)
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    rays = field.rays(random.uniform(-8, 28, (count, 3)) * (1, 0.2, 0.2), directions)
    edges = torch.from_numpy(np.sort(random.uniform(0, 1, (count, bins + 1)), axis=-1)).float()
    return rays, field.spacing(rays).metres(edges)


@torch.no_grad()
def along(field: TileField, network, rays, edges_m, left: float = 0.0):
    assert ray_density.suits(network.grid, edges_m)
    return field._ray_density(network, rays, edges_m, left)


@pytest.mark.parametrize("sub_field_count", [1, 2, 5])
@pytest.mark.parametrize(("features", "levels"), [(1, 3), (2, 8), (4, 2)])
def test_one_pass_says_the_same_as_operator_after_operator(sub_field_count, features, levels):
    field = field_of(sub_field_count, features, levels)
    rays, edges_m = rays_and_edges(field)
    for network in (field.trunk, *field.proposals):
        expected = field._density(network, rays.points(edges_m)).detach()
        assert expected.std() > expected.mean() / 10, "densities that vary"
        torch.testing.assert_close(along(field, network, rays, edges_m), expected, rtol=2e-4, atol=1e-6)


@pytest.mark.parametrize("left", [1e-3, 0.49])
def test_rays_end_where_they_are_followed_no_further(left):
    field = field_of(2)
    with torch.no_grad():
        field.trunk.network.biases[-1][:, 0] += 2  # so dense that many rays end soon
    rays, edges_m = rays_and_edges(field, bins=64)
    density = along(field, field.trunk, rays, edges_m, left)
    expected = weights_until(lambda points: field._density(field.trunk, points), rays, edges_m, left).detach()
    torch.testing.assert_close(ray_weights(density, edges_m.diff(dim=-1)), expected, rtol=1e-3, atol=1e-5)
    assert bool((density[:, :8] > 0).all())
    assert 0.1 < (density == 0).float().mean() < 0.9


def test_fog_is_nothing_to_a_ray_in_one_pass_and_operator_after_operator():
    field, left = field_of(2), 0.3
    with torch.no_grad():
        field.trunk.network.biases[-1][:, 0] += 2
    rays, edges_m = rays_and_edges(field, bins=64)
    whole = along(field, field.trunk, rays, edges_m)
    fog = float(whole.median())
    with torch.no_grad():
        density = field._ray_density(field.trunk, rays, edges_m, left, fog)
        expected = weights_until(lambda points: field._density(field.trunk, points), rays, edges_m, left, fog)
        through = field.weights(rays, edges_m, left, fog)
    torch.testing.assert_close(through, expected, rtol=1e-3, atol=1e-5)
    assert not ((density > 0) & (density < fog)).any()
    assert bool((density[density > 0] == whole[density > 0]).all())
    assert (density[:, 16:] > 0).sum() > (along(field, field.trunk, rays, edges_m, left)[:, 16:] >= fog).sum()


def test_a_ray_is_the_same_alone_and_whatever_the_number_of_threads():
    field = field_of(2)
    rays, edges_m = rays_and_edges(field)
    before = torch.get_num_threads()
    try:
        threads.use_threads(1)
        together = along(field, field.trunk, rays, edges_m)
        threads.use_threads(2)
        assert torch.equal(along(field, field.trunk, rays, edges_m), together)
    finally:
        threads.use_threads(before)
    alone = field.rays(rays.origins[7:8].numpy() + field.origin_m, rays.directions[7:8].numpy())
    torch.testing.assert_close(along(field, field.trunk, alone, edges_m[7:8]), together[7:8], rtol=1e-4, atol=1e-6)


def test_more_samples_than_go_through_together_are_no_matter():
    field = field_of(1)
    bins = 2 * ray_density.POINTS
    rays, edges_m = rays_and_edges(field, bins, count=2)
    expected = field._density(field.trunk, rays.points(edges_m)).detach()
    torch.testing.assert_close(along(field, field.trunk, rays, edges_m), expected, rtol=2e-4, atol=1e-6)


def test_no_rays_have_no_density():
    field = field_of(2)
    rays, edges_m = rays_and_edges(field, count=0)
    assert along(field, field.trunk, rays, edges_m).shape == (0, 32)


def test_there_is_nothing_beyond_the_grid():
    field = field_of(1)
    rays, _ = rays_and_edges(field, count=1)
    edges_m = torch.tensor([[0.0, 1.0, 2e9, 4e9]])
    density = along(field, field.trunk, rays, edges_m)
    assert (density > 0).tolist() == [[True, False, False]]


def test_what_is_no_number_stays_so():
    field = field_of(1)
    with torch.no_grad():
        field.trunk.network.biases[-1][:] = float("nan")
    rays, edges_m = rays_and_edges(field)
    assert bool(along(field, field.trunk, rays, edges_m)[:, 0].isnan().all())


def test_where_gradients_are_wanted_operators_are_asked():
    field = field_of(1)
    _, edges_m = rays_and_edges(field)
    assert not ray_density.suits(field.trunk.grid, edges_m)
    with torch.no_grad():
        assert ray_density.suits(field.trunk.grid, edges_m)
