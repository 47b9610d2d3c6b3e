import math

import pytest
import torch

from presight_core.config import StereoSettings, TrainingSettings
from presight_core.field import losses, rendering, samplers, schedule, threads
from presight_core.field.assignment import Assignment, assign
from presight_core.field.contraction import contract, grid_position, grid_positions
from presight_core.field.early_stop import weights_until
from presight_core.field.mlp import SubFieldMlp
from presight_core.field.rays import Rays
from presight_core.field.spherical_harmonics import spherical_harmonics


def test_contraction_leaves_the_unit_cube_alone():
    points = torch.rand(100, 3) * 2 - 1
    assert torch.equal(contract(points), points)


def test_contraction_keeps_all_of_space_within_two():
    assert contract(torch.randn(100, 3) * 1e6).abs().max() <= 2


def test_contraction_has_a_gradient_at_the_origin():
    origin = torch.zeros(1, 3, requires_grad=True)
    contract(origin).sum().backward()
    assert torch.equal(origin.grad, torch.ones(1, 3))


def test_a_point_too_far_to_tell_apart_is_not_on_the_grid():
    points = torch.tensor([[0.0, 0, 0], [1e12, 0, 0]])
    position, inside = grid_position(points, torch.zeros(3), torch.ones(3))
    assert inside.tolist() == [True, False]
    assert position[1].tolist() == [0, 0, 0]


def test_spherical_harmonics_are_orthonormal():
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(
        torch.randn(200_000, 3, generator=generator, dtype=torch.float64), dim=-1
    )
    basis = spherical_harmonics(directions)
    gram = basis.T @ basis / len(directions) * 4 * torch.pi
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), atol=0.03, rtol=0)  # sampling error


def test_a_ray_ends_at_the_floor_and_only_there():
    down, level, up = [0.6, 0.0, -0.8], [1.0, 0.0, 0.0], [0.6, 0.0, 0.8]
    directions = torch.tensor([down, level, up])
    far = samplers.far_above_floor(directions, far_m=1000.0, floor_m=4.0, slope=0.1)
    end = far[0] * directions[0]
    torch.testing.assert_close(end[2], -(4.0 + 0.1 * end[0]))
    assert far[1:].flatten().tolist() == [1000.0, 1000.0]


@pytest.mark.parametrize("padding", [0.0, 0.01])
@pytest.mark.parametrize("has_jitter", [True, False])
def test_samples_are_placed_alike_ray_by_ray_and_operator_by_operator(padding, has_jitter):
    edges, _ = torch.rand(40, 33, dtype=torch.float64).sort()
    weights = torch.rand(40, 32, dtype=torch.float64) ** 8
    weights[:4] = 0
    offset = torch.rand(40, 1, dtype=torch.float64) if has_jitter else torch.full((40, 1), 0.5, dtype=torch.float64)
    found = samplers.resample(edges, weights, 16, offset if has_jitter else None, padding)
    torch.testing.assert_close(found, samplers._in_passes(edges, weights, 16, offset, padding))
    assert (found.diff() >= 0).all()


def test_no_ray_ends_beyond_the_far_plane():
    directions = torch.nn.functional.normalize(torch.randn(1000, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    far = samplers.far_above_floor(directions, far_m=100.0, floor_m=4.0, slope=0.1)
    assert far.max() == 100.0
    assert far.min() >= 4.0 / 1.1


def test_spacing_and_metres_are_inverses():
    metres = torch.tensor([0.5, 50.0, 99.0, 101.0, 900.0], dtype=torch.float64)
    torch.testing.assert_close(samplers.metres_from_spacing(samplers.spacing_from_metres(metres, 100), 100), metres)


def test_s_runs_from_the_near_to_the_far_plane():
    ends = samplers.Spacing(1.0, 500.0, 100.0).metres(torch.tensor([0.0, 1.0], dtype=torch.float64))
    torch.testing.assert_close(ends, torch.tensor([1.0, 500.0], dtype=torch.float64))


@pytest.mark.parametrize("jitter", [0.0, 0.5, 0.999])
def test_jittered_edges_ascend_within_zero_and_one(jitter):
    edges = samplers.uniform_edges(2, 8, torch.full((2, 1), jitter), torch.zeros(()))
    assert bool((edges.diff(dim=-1) > 0).all())
    assert edges.min() >= 0
    assert edges.max() <= 1


def test_resampling_puts_samples_where_the_weight_is():
    edges = torch.linspace(0, 1, 11)[None]
    weights = torch.zeros(1, 10)
    weights[0, 3] = 1
    new = samplers.resample(edges, weights, 16, None, padding=0.0)
    assert bool(((new >= 0.3 - 1e-6) & (new <= 0.4 + 1e-6)).all())


def test_resampling_an_empty_ray_is_uniform():
    new = samplers.resample(torch.linspace(0, 1, 11)[None], torch.zeros(1, 10), 9, None, padding=0.0)
    torch.testing.assert_close(new[0], torch.linspace(0.05, 0.95, 10))


def test_weights_and_what_is_left_make_one():
    density, lengths = torch.rand(5, 20) * 3, torch.rand(5, 20)
    left = torch.exp(-(density * lengths).sum(-1))
    torch.testing.assert_close(rendering.ray_weights(density, lengths).sum(-1) + left, torch.ones(5))


def test_first_hit_lies_where_half_of_the_weight_is_reached():
    weights = torch.tensor([[0.0, 0.25, 0.5, 0.25], [0.1, 0.1, 0.1, 0.1]])
    depth, found = rendering.first_hit_depth(weights, torch.tensor([[0.0, 1, 2, 4, 5]]).expand(2, -1))
    assert found.tolist() == [True, False]
    assert depth[0] == 3.0  # a quarter before the third sample, which spans 2..4: halfway through it


def test_no_output_is_too_large_for_a_density_and_what_is_opaque_hides_all_behind():
    density = rendering.truncated_exponential(torch.tensor([[0.0, 89.0, 1000.0, torch.inf]]))
    weights = rendering.ray_weights(density, torch.full((1, 4), 0.1))
    torch.testing.assert_close(weights.sum(), torch.tensor(1.0))
    assert weights[0, 2:].sum() < 1e-6


def test_truncated_exponential_has_a_bounded_gradient():
    x = torch.tensor([1.0, 30.0], requires_grad=True)
    rendering.truncated_exponential(x).sum().backward()
    torch.testing.assert_close(x.grad, torch.tensor([1.0, 15.0]).exp())


def test_a_density_beyond_its_bounds_learns_only_what_leads_back():
    x = torch.tensor([-20.0, -20.0, 20.0, 20.0], requires_grad=True)
    rendering.truncated_exponential(x).backward(torch.tensor([1.0, -1.0, 1.0, -1.0]))
    assert x.grad is not None
    torch.testing.assert_close(x.grad, torch.tensor([0.0, -15.0, 15.0, 0.0]).exp() * torch.tensor([0, -1, 1, 0]))


def test_what_should_be_empty_does_not_run_away_in_a_long_training():
    x = torch.full((1,), -14.0, requires_grad=True)
    optimiser = torch.optim.AdamW([x], lr=0.1, eps=1e-15, weight_decay=0.0)
    for _ in range(1000):
        rendering.truncated_exponential(x).sum().backward()
        optimiser.step()
        optimiser.zero_grad()
    assert -17 < x.item() < -15  # a gradient that goes on beyond -15 takes it to -110


def random_histogram(bins: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    edges = torch.rand(6, bins + 1, generator=generator, dtype=torch.float64).sort(-1).values
    weights = torch.rand(6, bins, generator=generator, dtype=torch.float64)
    return edges, weights / weights.sum(-1, keepdim=True)


def test_the_ground_loss_is_the_missing_weight_beyond_the_start_of_the_ground():
    weights = torch.tensor([[0.25, 0.5, 0.0], [0.0, 0.0, 0.0]])
    middles_m = torch.tensor([[1.0, 2.0, 3.0]]).expand(2, 3)
    loss = losses.ground_loss(weights, middles_m, torch.tensor([1.5, 0.0]))
    assert loss.item() == pytest.approx(-math.log((0.5 + 0.1) / 1.1) / 2)  # the second ray knows of no ground


def test_the_stereo_loss_is_the_missing_weight_near_the_known_depth():
    weights = torch.tensor([[0.25, 0.5, 0.125], [0.25, 0.5, 0.125], [0.0, 0.0, 0.0]])
    edges_m = torch.tensor([[0.0, 1.0, 2.0, 3.0], [28.0, 30.0, 32.0, 36.0], [0.0, 1.0, 2.0, 3.0]])
    loss = losses.stereo_loss(weights, edges_m, torch.tensor([1.4, 32.5, 0.0]), 0.05)
    one = weights[0, :2].sum()  # the bin that holds 1.4 m, and the one before it: neither middle is a bin away
    two = weights[1, 1:].sum()  # likewise
    expected = -torch.log((torch.stack([one, two]) + 0.1) / 1.1).sum() / 3  # of the third nothing is known
    torch.testing.assert_close(loss, expected)


def test_a_bin_holds_the_depths_from_its_first_edge_to_before_its_last():
    edges_m = torch.tensor([[1.0, 2.0, 4.0, 8.0]]).expand(2, -1)
    depths_m = torch.tensor([[2.0, 3.9, 0.0], [1.0, 8.0, 7.0]])
    expected = torch.tensor([[0.0, 2.0, 0.0], [1.0, 0.0, 1.0]])
    assert torch.equal(samplers.held(edges_m, depths_m), expected)


def test_fading_keeps_values_and_scales_gradients_by_the_squared_distance():
    density = torch.ones(1, 3, requires_grad=True)
    edges_m = torch.tensor([[0.0, 2.0, 8.0, 40.0]])  # middles at 1, 5 and 24 m
    faded = rendering.fade_gradient(density, rendering.share_of_rays(edges_m, 10.0))
    assert torch.equal(faded, density)
    faded.sum().backward()
    assert density.grad is not None
    torch.testing.assert_close(density.grad, torch.tensor([[0.01, 0.25, 1.0]]))


def test_distortion_equals_the_sum_over_all_pairs():
    edges, weights = random_histogram(9, 0)
    middles = (edges[:, 1:] + edges[:, :-1]) / 2
    pairs = weights[:, :, None] * weights[:, None] * (middles[:, :, None] - middles[:, None]).abs()
    expected = pairs.sum((1, 2)) + (weights**2 * edges.diff(dim=-1)).sum(-1) / 3
    torch.testing.assert_close(losses.distortion(edges, weights), expected)


def test_a_proposal_equal_to_the_field_has_no_interlevel_loss():
    edges, weights = random_histogram(9, 1)
    assert losses.interlevel_loss(edges, weights, edges, weights) < 1e-12


def test_interlevel_losses_teach_the_proposal_only():
    (edges, weights), (proposal_edges, proposal) = random_histogram(9, 2), random_histogram(7, 3)
    weights.requires_grad_()
    proposal.requires_grad_()
    loss = losses.blurred_interlevel_loss(edges, weights, proposal_edges, proposal, 0.03)
    (loss + losses.interlevel_loss(edges, weights, proposal_edges, proposal)).backward()
    assert weights.grad is None
    assert proposal.grad.abs().max() > 0


def test_a_narrow_blur_changes_a_cumulative_sum_little():
    edges, weights = random_histogram(9, 4)
    plain = torch.nn.functional.pad(weights.cumsum(-1), (1, 0))
    blurred = losses.blurred_cumulative(edges, weights, edges, 1e-6)
    torch.testing.assert_close(blurred, plain, atol=1e-3, rtol=0)


def test_sky_loss_is_small_when_only_the_sky_is_empty():
    is_sky = torch.tensor([True, False])
    right, wrong = torch.tensor([0.01, 0.99]), torch.tensor([0.99, 0.01])
    assert losses.sky_loss(right, is_sky) < 0.02 < losses.sky_loss(wrong, is_sky)


def test_sky_loss_passes_over_rays_without_a_label():
    accumulation, is_sky = torch.rand(6), torch.tensor([True, False, True, False, True, False])
    is_known = torch.tensor([True, True, False, False, True, False])
    expected = losses.sky_loss(accumulation[is_known], is_sky[is_known])
    torch.testing.assert_close(losses.sky_loss(accumulation, is_sky, is_known), expected)
    assert losses.sky_loss(accumulation, is_sky, torch.zeros(6, dtype=torch.bool)) == 0


def test_learning_rate_rises_then_drops():
    settings = TrainingSettings(steps=100, learning_rate=1.0, warmup=0.1, decay_at=(0.5,), decay=0.33)
    rates = [schedule.learning_rate(step, settings) for step in (0, 10, 49, 50)]
    assert rates == pytest.approx([0.01, 1.0, 1.0, 0.33])


def test_annealing_ends_at_one():
    settings = TrainingSettings(steps=100, anneal=0.1)
    exponents = [schedule.anneal_exponent(step, settings) for step in range(20)]
    assert exponents[0] == 0
    assert exponents == sorted(exponents)
    assert exponents[-1] == 1


def test_what_neighbouring_images_tell_weighs_less_and_less_in_long_trainings():
    settings = TrainingSettings(steps=3000, stereo=StereoSettings(fades_from=1000))
    shares = [schedule.stereo_share(step, settings) for step in (0, 1000, 2000, 3000)]
    assert shares == pytest.approx([1, 1, 0.5, 0])
    short = settings.model_copy(update={"steps": 400})
    assert [schedule.stereo_share(step, short) for step in (0, 399)] == [1, 1]


def test_points_go_to_the_nearest_centroid_and_back_in_order():
    centroids = torch.tensor([[0.0, 0, 0], [10, 0, 0], [0, 10, 0]])
    points = torch.tensor([[9.0, 1, 0], [1, 0, 0], [0, 8, 1], [1, 1, 1], [11, 0, 0]])
    assignment = assign(points, centroids)
    assert assignment.bounds == [0, 2, 4, 5]
    assert torch.equal(assignment.restore(assignment.sort(points)), points)


def test_restoring_passes_gradients_to_the_right_rows():
    points = torch.tensor([[10.0, 0, 0], [0, 0, 0]])
    assignment = assign(points, torch.tensor([[0.0, 0, 0], [10, 0, 0]]))
    values = torch.tensor([1.0, 2.0], requires_grad=True)
    (assignment.restore(values) * torch.tensor([5.0, 7.0])).sum().backward()
    assert values.grad.tolist() == [7, 5]


def random_network(widths: tuple[int, ...], seed: int = 0) -> SubFieldMlp:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = SubFieldMlp(2, widths).double()
    network.dtype = torch.float64
    return network


def test_gradients_of_networks_agree_with_finite_differences(monkeypatch):
    monkeypatch.setattr("presight_core.field.mlp.BLOCK_BYTES", 2 * 64 * 8)  # blocks of one and of two rows
    network = random_network((3, 4, 4, 2))
    inputs = torch.randn(5, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64, requires_grad=True)
    assignment = Assignment(torch.tensor([0, 2, 5]))

    def outputs(inputs: torch.Tensor, *_: torch.Tensor) -> torch.Tensor:
        return network(inputs, assignment)

    assert torch.autograd.gradcheck(outputs, (inputs, *network.parameters()))


def test_networks_equal_plain_layers_whatever_the_block(monkeypatch):
    network = random_network((3, 8, 2))
    inputs = torch.randn(50, 3, dtype=torch.float64)
    whole = network(inputs, Assignment(torch.tensor([0, 20, 50])))
    monkeypatch.setattr("presight_core.field.mlp.BLOCK_BYTES", 7 * 64 * 8)  # seven rows
    torch.testing.assert_close(network(inputs, Assignment(torch.tensor([0, 20, 50]))), whole)
    weights, biases = [weight[1] for weight in network.weights], [bias[1] for bias in network.biases]
    plain = torch.relu(inputs[20:] @ weights[0].T + biases[0]) @ weights[1].T + biases[1]
    torch.testing.assert_close(whole[20:], plain)


def test_half_precision_networks_add_gradients_up_in_single_precision():
    network = SubFieldMlp(1, (4, 4, 1))
    network.dtype = torch.bfloat16
    inputs = torch.ones(10_000, 4)
    network(inputs, Assignment(torch.tensor([0, 10_000]))).float().sum().backward()
    assert network.biases[1].grad.item() == 10_000  # bfloat16 stops counting at 256


def test_rows_that_fill_half_precision_blocks_up_change_nothing(monkeypatch):
    network = random_network((5, 16, 3)).float()
    network.dtype = torch.bfloat16
    inputs, assignment, found = torch.randn(50, 5, requires_grad=True), Assignment(torch.tensor([0, 20, 50])), []
    for rows in (1, 32):
        monkeypatch.setattr("presight_core.field.mlp.HALF_ROWS", rows)
        output = network(inputs, assignment)
        found.append([output, *torch.autograd.grad(output.float().square().sum(), (inputs, *network.parameters()))])
    for plain, filled in zip(*found, strict=True):
        torch.testing.assert_close(filled, plain, rtol=0.02, atol=0.02)  # a library sums in another order


@pytest.mark.parametrize("exponent", [-3.0, 0.5, 4.0])
def test_truncated_exponential_agrees_with_finite_differences_within_its_bounds(exponent):
    x = torch.tensor([exponent], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(rendering.truncated_exponential, (x,))


def test_gradients_of_restoring_agree_with_finite_differences():
    points = torch.tensor([[9.0, 1, 0], [1, 0, 0], [0, 8, 1], [11, 0, 0]])
    assignment = assign(points, torch.tensor([[0.0, 0, 0], [10, 0, 0], [0, 10, 0]]))
    values = torch.randn(4, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(assignment.restore, (values,))


def test_gradients_of_rendering_agree_with_finite_differences():
    generator = torch.Generator().manual_seed(0)
    density = torch.rand(3, 6, generator=generator, dtype=torch.float64, requires_grad=True)
    lengths = torch.rand(3, 6, generator=generator, dtype=torch.float64)
    values = torch.rand(3, 6, 2, generator=generator, dtype=torch.float64, requires_grad=True)

    def seen(density: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        return rendering.blend(rendering.ray_weights(density, lengths), values)

    assert torch.autograd.gradcheck(seen, (density, values))


def test_gradients_of_losses_agree_with_finite_differences():
    (edges, weights), (proposal_edges, proposal) = random_histogram(9, 2), random_histogram(7, 3)
    weights.requires_grad_()
    proposal.requires_grad_()
    accumulation = torch.tensor([0.2, 0.7], dtype=torch.float64, requires_grad=True)
    checks = [
        (lambda value: losses.distortion_loss(edges, value), weights),
        (lambda value: losses.interlevel_loss(edges, weights, proposal_edges, value), proposal),
        (lambda value: losses.blurred_interlevel_loss(edges, weights, proposal_edges, value, 0.03), proposal),
        (lambda value: losses.sky_loss(value, torch.tensor([True, False])), accumulation),
    ]
    for loss, value in checks:
        assert torch.autograd.gradcheck(loss, (value,))


def test_each_sub_field_has_its_own_network():
    network = SubFieldMlp(2, (3, 4, 2))
    inputs = torch.ones(5, 3)
    outputs = network(inputs, Assignment(torch.tensor([0, 2, 5])))
    assert torch.equal(outputs[0], outputs[1])
    assert torch.equal(outputs[2], outputs[4])
    assert not torch.equal(outputs[0], outputs[2])


def test_positions_in_one_pass_equal_those_of_each_sub_field():
    points = torch.randn(200, 3, generator=torch.Generator().manual_seed(0)) * torch.logspace(-2, 12, 200)[:, None]
    centres, half_sizes = torch.tensor([[0.0, 1, 2], [-3, 0, 0]]), torch.tensor([[1.0, 2, 3], [4, 1, 1]])
    positions, inside = grid_positions(points, torch.tensor([0, 90, 200]), centres, half_sizes)
    parts = [
        grid_position(points[rows], centres[sub_field], half_sizes[sub_field])
        for sub_field, rows in enumerate((slice(0, 90), slice(90, 200)))
    ]
    torch.testing.assert_close(positions, torch.cat([part[0] for part in parts]), atol=1e-7, rtol=0)
    assert torch.equal(inside, torch.cat([part[1] for part in parts]))
    assert set(inside.tolist()) == {True, False}


def test_following_rays_to_their_end_gives_the_weights_of_all_samples_in_front():
    edges = torch.linspace(0, 10, 41).expand(3, -1)
    rays = Rays(torch.zeros(3, 3), torch.eye(3))
    looked_at = []

    def density_at(points: torch.Tensor) -> torch.Tensor:
        looked_at.append(points.shape[:2].numel())
        return torch.where(points[..., 0] > 3, 20.0, 0.01)  # a wall across the first ray alone

    found = weights_until(density_at, rays, edges, left=1e-3)
    looked_at_early = sum(looked_at)
    plain = rendering.ray_weights(density_at(rays.points(edges)), edges.diff(dim=-1))
    torch.testing.assert_close(found, plain, atol=1e-3, rtol=0)
    assert looked_at_early < 3 * 40
    assert not found[0, 20:].any()


@pytest.mark.parametrize(("has_products", "has_tiles"), [(False, False), (True, False), (True, True)])
def test_a_processor_calculates_in_bfloat16_only_if_it_has_instructions_for_it(monkeypatch, has_products, has_tiles):
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: has_products)
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: has_tiles)
    assert threads.has_fast_bfloat16("cpu") is has_products


@pytest.mark.parametrize("rows", [1, 700])
def test_half_precision_networks_cut_what_is_negative_and_keep_what_is_no_number(rows):
    network = SubFieldMlp(1, (1, 3, 3))
    network.dtype = torch.bfloat16
    with torch.no_grad():
        network.weights[0].copy_(torch.tensor([[[1.0], [-1.0], [torch.nan]]]))
        network.weights[1].copy_(torch.eye(3)[None])
        network.biases[0].zero_()
        network.biases[1].zero_()
    inputs = torch.full((rows, 1), 2.0, requires_grad=True)
    outputs = network(inputs, Assignment(torch.tensor([0, rows]))).float()
    assert outputs.isnan().all()
    network.weights[0].data[0, 2] = -5.0
    outputs = network(inputs, Assignment(torch.tensor([0, rows]))).float()
    assert outputs.tolist() == [[2.0, 0.0, 0.0]] * rows
    outputs.sum().backward()
    assert inputs.grad.tolist() == [[1.0]] * rows
