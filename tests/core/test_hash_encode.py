import numba
import pytest
import torch

from presight_core.config import GridSettings
from presight_core.field.hash_encode import (
    GridLayout,
    grid_layout,
    hash_encode,
    numba_kernels,
    point_gradient,
    table_gradient,
    torch_reference,
)

SIZES = [(4, 4), (3, 1), (3, 2)]  # levels and features: vector kernels need four, others take the scalar path


def small_layout(levels: int, features: int, sub_fields: int = 3) -> GridLayout:
    """A grid with dense coarse levels and hashed fine ones."""
    settings = GridSettings(
        levels=levels, features_per_level=features, min_resolution=3, max_resolution=40, log2_rows=8
    )
    layout = grid_layout(settings, sub_fields)
    assert set(layout.hashed) == {True, False}
    return layout


def arguments(layout: GridLayout, count: int = 200) -> tuple[torch.Tensor, ...]:
    """Random points (an empty sub-field among them), table, offsets and levels."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(count, 3, generator=generator)
    segments = torch.tensor([0, count // 3, count // 3, count])[: layout.sub_field_count + 1]
    table = torch.randn(layout.table_rows, layout.features, generator=generator)
    return points, segments, table, layout.offsets(), layout.levels()


@pytest.mark.parametrize(("levels", "features"), SIZES)
def test_fast_kernel_agrees_with_plain_torch(levels, features):
    inputs = arguments(small_layout(levels, features))
    torch.testing.assert_close(hash_encode(*inputs), torch_reference.encode(*inputs), atol=1e-6, rtol=0)


@pytest.mark.parametrize(("levels", "features"), SIZES)
def test_gradients_agree_with_plain_torch(levels, features):
    points, segments, table, offsets, levels_ = arguments(small_layout(levels, features))
    points.requires_grad_()
    table.requires_grad_()
    upstream = torch.randn(len(points), levels * features, generator=torch.Generator().manual_seed(1))
    fast = torch.autograd.grad(hash_encode(points, segments, table, offsets, levels_), (points, table), upstream)
    plain = torch_reference.encode(points, segments, table, offsets, levels_)
    slow = torch.autograd.grad(plain, (points, table), upstream)
    for found, expected in zip(fast, slow, strict=True):
        torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-5)  # slopes add up hundreds


def test_a_rounded_copy_is_read_in_the_tables_place():
    points, segments, table, offsets, levels = arguments(small_layout(4, 4))
    copy = table.bfloat16()
    table = torch.full_like(table, 7.0).requires_grad_()
    output = hash_encode(points, segments, table, offsets, levels, copy)
    assert output.dtype == torch.bfloat16
    expected = torch_reference.encode(points, segments, copy.float(), offsets, levels)
    torch.testing.assert_close(output.float(), expected, atol=0.02, rtol=0.01)  # bfloat16 has 8 bits
    upstream = torch.ones_like(output)
    (gradient,) = torch.autograd.grad(output, table, upstream)
    expected = torch_reference.table_gradient(points, segments, upstream.float(), offsets, levels, len(table))
    assert gradient.dtype == torch.float32
    torch.testing.assert_close(gradient, expected, atol=1e-5, rtol=1e-5)


def test_point_gradient_agrees_with_finite_differences():
    points, segments, table, offsets, levels = (
        value.double() if value.is_floating_point() else value for value in arguments(small_layout(3, 2), 12)
    )
    upstream = torch.randn(12, 6, dtype=torch.float64)
    step = 1e-7  # far below a cell of the finest level
    found = torch_reference.point_gradient(points, segments, table, offsets, levels, upstream)
    for axis in range(3):
        moved = torch.zeros(3, dtype=torch.float64)
        moved[axis] = step
        ahead = torch_reference.encode(points + moved, segments, table, offsets, levels)
        behind = torch_reference.encode(points - moved, segments, table, offsets, levels)
        slope = ((ahead - behind) / (2 * step) * upstream).sum(-1)
        torch.testing.assert_close(found[:, axis], slope, atol=1e-5, rtol=1e-5)


def test_table_gradient_agrees_with_finite_differences():
    points, segments, table, offsets, levels = arguments(small_layout(4, 4), 5)
    table.requires_grad_()
    upstream = torch.randn(5, 16)
    (gradient,) = torch.autograd.grad(hash_encode(points, segments, table, offsets, levels), table, upstream)
    touched = gradient.abs().sum(-1).argsort(descending=True)[:5]
    for row in touched.tolist():
        bumped = table.detach().clone()
        bumped[row] += 1.0  # the encoding is linear in the table: any step is exact
        change = hash_encode(points, segments, bumped, offsets, levels) - hash_encode(
            points, segments, table, offsets, levels
        )
        torch.testing.assert_close((change * upstream).sum(), gradient[row].sum(), atol=1e-4, rtol=1e-4)


def test_operators_pass_torchs_own_checks():
    points, segments, table, offsets, levels = arguments(small_layout(4, 4), 20)
    upstream = torch.randn(20, 16)
    where = (segments, offsets, levels)
    torch.library.opcheck(point_gradient, (points, segments, table, offsets, levels, upstream))
    torch.library.opcheck(table_gradient, (points, segments, upstream, offsets, levels, len(table)))
    for copy in (None, table.bfloat16()):
        needs = points.clone().requires_grad_(), table.clone().requires_grad_()
        torch.library.opcheck(hash_encode, (needs[0], where[0], needs[1], *where[1:], copy))


def test_two_runs_of_the_gradient_are_equal_bit_for_bit():
    points, segments, table, offsets, levels = arguments(small_layout(4, 4), 5000)
    upstream = torch.randn(5000, 16)
    first, second = (table_gradient(points, segments, upstream, offsets, levels, len(table)) for _ in range(2))
    assert torch.equal(first, second)


def test_asking_for_rows_of_a_large_table_ahead_changes_nothing():
    settings = GridSettings(levels=2, features_per_level=4, max_resolution=4096, log2_rows=18)
    layout = grid_layout(settings)
    assert layout.rows[-1] * layout.features >= numba_kernels.PREFETCHED_VALUES
    points, table = torch.rand(100, 3), torch.randn(layout.table_rows, 4)
    inputs = (points, torch.tensor([0, 100]), table, layout.offsets(), layout.levels())
    torch.testing.assert_close(hash_encode(*inputs), torch_reference.encode(*inputs), atol=1e-5, rtol=0)


def test_result_does_not_depend_on_the_number_of_threads():
    points, segments, table, offsets, levels = arguments(small_layout(4, 4), 1000)
    table.requires_grad_()
    results = []
    before = numba.get_num_threads()
    try:
        for count in {1, before}:
            numba.set_num_threads(count)
            output = hash_encode(points, segments, table, offsets, levels)
            results.append((output.detach(), *torch.autograd.grad(output.square().sum(), table)))
    finally:
        numba.set_num_threads(before)
    for found in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], found, strict=True))


def test_a_value_on_a_lattice_corner_is_that_corners_row():
    layout = small_layout(4, 4, sub_fields=1)
    table = torch.arange(layout.table_rows * 4, dtype=torch.float32).view(-1, 4)
    resolution = layout.resolutions[0]
    assert not layout.hashed[0]
    point = torch.tensor([[1, 2, 0]]) / resolution
    output = hash_encode(point, torch.tensor([0, 1]), table, layout.offsets(), layout.levels())
    torch.testing.assert_close(output[0, :4], table[1 + 2 * (resolution + 1)])


def test_points_outside_the_cube_stay_inside_the_table():
    layout = small_layout(4, 4, sub_fields=1)
    points = torch.tensor([[1.0, 1.0, 1.0], [float("nan"), 0.5, 0.5]])
    table = torch.zeros(layout.table_rows, 4, requires_grad=True)
    output = hash_encode(points, torch.tensor([0, 2]), table, layout.offsets(), layout.levels())
    output.sum().backward()
    assert table.grad is not None
    assert table.grad.shape == table.shape


def test_no_points_give_no_rows():
    layout = small_layout(4, 4, sub_fields=1)
    output = hash_encode(
        torch.zeros(0, 3), torch.tensor([0, 0]), torch.zeros(layout.table_rows, 4), layout.offsets(), layout.levels()
    )
    assert output.shape == (0, 16)


def test_offsets_of_large_grids_pass_32_bits():
    settings = GridSettings(levels=10, features_per_level=4, max_resolution=16384, log2_rows=24)
    offsets = grid_layout(settings, 30).offsets()
    assert offsets.dtype == torch.int64
    assert offsets[-1, -1] > 2**31
    assert bool((offsets.flatten().diff() > 0).all())


def test_the_finest_resolution_is_the_one_asked_for():
    settings = GridSettings(levels=10, features_per_level=4, max_resolution=16384, log2_rows=20)
    assert grid_layout(settings).resolutions[-1] == 16384
