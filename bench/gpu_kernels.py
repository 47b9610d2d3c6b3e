"""Sections of `bench/gpu.py` about single kernels."""

import platform
from collections.abc import Callable

import numpy as np
import torch
from gpu_sizes import Bench, Result
from torch import Tensor

from presight_core.config import GridSettings
from presight_core.field.assignment import Assignment
from presight_core.field.hash_encode import grid_layout, hash_encode, table_gradient, torch_reference
from presight_core.field.mlp import SubFieldMlp

NETWORKS = ((8, 64, 1), (40, 64, 80), (47, 64, 64, 3), (64, 64, 64, 64))  # proposal, trunk, colour, semantics


def device_section(bench: Bench) -> Result:
    """What the machine is, and how fast it copies and multiplies: the ceilings."""
    import triton

    found: Result = {"python": platform.python_version(), "torch": torch.__version__, "triton": triton.__version__}
    if bench.on_card:
        properties = torch.cuda.get_device_properties(bench.device)
        found |= {"card": properties.name, "memory_gib": properties.total_memory / 2**30}
    source = torch.rand(2**28 if bench.is_paper else 2**10, device=bench.device)
    target = torch.empty_like(source)
    copied = bench.milliseconds(lambda: target.copy_(source))
    found["copy_gb_per_s"] = 2 * source.nbytes / copied / 1e6
    side = 8192 if bench.is_paper else 32
    factors = torch.randn(2, side, side, device=bench.device, dtype=torch.bfloat16)
    found["bfloat16_tflop_per_s"] = 2 * side**3 / bench.milliseconds(lambda: factors[0] @ factors[1]) / 1e9
    return found


def check_section(bench: Bench) -> Result:
    """Kernels against plain torch. Raises AssertionError for an error above its bound."""
    found: Result = {}
    for name, (grid, _) in bench.grids.items():
        found |= {f"{name}: {what}": error for what, error in _hash_errors(bench, grid).items()}
    for widths in NETWORKS:
        found[f"network {widths}"] = _network_error(bench, widths if bench.is_paper else (widths[0], 16, 1))
    bounds = {"network": 3e-2 if bench.dtype == torch.bfloat16 else 1e-5, "half": 1e-2, "points": 1e-4}
    for name, error in found.items():
        bound = next((bounds[part] for part in bounds if part in name), 1e-5)
        assert error <= bound, f"{name}: error {error:.1e} exceeds {bound:.0e}"
    return found


def _hash_errors(bench: Bench, grid: GridSettings) -> dict[str, float]:
    points, segments = bench.points(2**16 if bench.is_paper else 60)
    layout = grid_layout(grid, bench.sub_field_count)
    offsets, levels = layout.offsets().to(bench.device), layout.levels().to(bench.device)
    table = torch.randn(layout.table_rows, layout.features, device=bench.device).requires_grad_()
    points.requires_grad_()
    output = hash_encode(points, segments, table, offsets, levels)
    upstream = torch.randn_like(output)
    of_points, of_table = torch.autograd.grad(output, (points, table), upstream)
    places = points.detach()
    plain = torch_reference.encode(places, segments, table.detach(), offsets, levels)
    copy = table.detach().to(torch.bfloat16 if bench.is_paper else torch.float16)
    half = hash_encode(places, segments, table.detach(), offsets, levels, copy)
    arguments = (places, segments, upstream, offsets, levels, len(table))
    slopes = torch_reference.point_gradient(places, segments, table.detach(), offsets, levels, upstream)
    return {
        "values": _error(output, plain),
        "table gradient": _error(of_table, torch_reference.table_gradient(*arguments)),
        "points' gradient": _error(of_points, slopes),
        "half copy": _error(half, plain),
    }


def _network_error(bench: Bench, widths: tuple[int, ...]) -> float:
    """Of values and gradients together, against one sub-field after the other in float32."""
    network = SubFieldMlp(bench.sub_field_count, widths).to(bench.device)
    inputs, segments = bench.points(2**16 if bench.is_paper else 200)
    inputs = torch.randn(len(inputs), widths[0], device=bench.device, requires_grad=True)
    wanted = (inputs, *network.parameters())
    expected = network.blockwise(inputs, segments.tolist())
    upstream = torch.randn_like(expected)
    plain = (expected, *torch.autograd.grad(expected, wanted, upstream))
    network.dtype = bench.dtype
    output = network(inputs, Assignment(segments))
    found = (output, *torch.autograd.grad(output, wanted, upstream.to(output.dtype)))
    return max(_error(*pair) for pair in zip(found, plain, strict=True))


def _error(found: Tensor, expected: Tensor) -> float:
    """The length of the difference as a share of the expected length; infinite if something is no number."""
    found, expected = found.detach().float(), expected.detach().float()
    error = float((found - expected).norm() / expected.norm())
    return error if np.isfinite(error) else float("inf")


def encode_section(bench: Bench) -> Result:
    """Milliseconds of each grid's encoding there and back, with several ways to cut up the work."""
    found: Result = {}
    for name, (grid, count) in bench.grids.items():
        found |= {f"{name}, {what}, ms": ms for what, ms in _encode_times(bench, grid, count).items()}
    return found


def _encode_times(bench: Bench, grid: GridSettings, count: int) -> dict[str, float]:
    from presight_core.field.hash_encode.triton_kernels import Launch, encode
    from presight_core.field.hash_encode.triton_kernels import table_gradient as triton_table_gradient

    points, segments = bench.points(count)
    layout = grid_layout(grid, bench.sub_field_count)
    offsets, levels = layout.offsets().to(bench.device), layout.levels().to(bench.device)
    table = torch.randn(layout.table_rows, layout.features, device=bench.device)
    upstream = torch.randn(count, layout.output_width, device=bench.device)
    copy, half = table.bfloat16(), upstream.bfloat16()
    if not bench.is_paper:
        copy, half = table.half(), upstream.half()
    there, back = (points, segments, table, offsets, levels), (offsets, levels, len(table))
    calls: dict[str, Callable[[], Tensor]] = {
        "forward": lambda: hash_encode(*there),
        "forward, half copy": lambda: hash_encode(*there, copy),
        "backward": lambda: table_gradient(points, segments, upstream, *back),
        "backward, half copy": lambda: table_gradient(points, segments, half, *back),
    }
    launches = [Launch(block, some, warps) for some in (1, 2, len(levels)) for block, warps in ((128, 4), (256, 8))]
    for launch in launches if bench.is_paper else []:
        label = f"{launch.points} points, {launch.levels} levels, {launch.warps} warps"
        calls[f"forward, {label}"] = lambda launch=launch: encode(*there, launch=launch)
        calls[f"backward, {label}"] = lambda launch=launch: triton_table_gradient(
            points, segments, upstream, *back, launch=launch
        )
    return {call: bench.milliseconds(function, 5) for call, function in calls.items()}


def network_section(bench: Bench) -> Result:
    """Milliseconds of each kind of network, there and there-and-back, at the main field's number of points."""
    found: Result = {}
    count = bench.grids["main"][1]
    for widths in NETWORKS:
        found |= {f"{widths}, {what}, ms": ms for what, ms in _network_times(bench, widths, count).items()}
    return found


def _network_times(bench: Bench, widths: tuple[int, ...], count: int) -> dict[str, float]:
    network = SubFieldMlp(bench.sub_field_count, widths).to(bench.device)
    network.dtype = bench.dtype
    _, segments = bench.points(count)
    inputs = torch.randn(count, widths[0], device=bench.device).to(bench.dtype).requires_grad_()
    assignment = Assignment(segments)

    def both() -> None:
        network(inputs, assignment).sum().backward()

    with torch.no_grad():
        forward = bench.milliseconds(lambda: network(inputs, assignment))
    return {"forward": forward, "forward and backward": bench.milliseconds(both)}
