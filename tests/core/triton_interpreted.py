"""Kernels under Triton's interpreter, in a process of their own: the interpreter is chosen before the first import.

`TRITON_INTERPRET=1 python -m tests.core.triton_interpreted PART` prints the error of every case as JSON.
"""

import json
import sys
from collections.abc import Callable

import torch
from torch import Tensor

from presight_core.config import GridSettings
from presight_core.field.assignment import Assignment
from presight_core.field.hash_encode import grid_layout, hash_encode, torch_reference
from presight_core.field.hash_encode.triton_kernels import Launch, encode
from presight_core.field.mlp import SubFieldMlp

POINTS = 90  # the second block of 64 is not full


def hash_cases() -> dict[str, float]:
    """Errors of the encoding and its gradients against plain torch."""
    errors = {}
    for level_count, features in ((3, 4), (2, 1), (2, 3)):
        points, segments, table, offsets, levels = _arguments(level_count, features)
        table.requires_grad_()
        points.requires_grad_()
        output = hash_encode(points, segments, table, offsets, levels)
        upstream = torch.randn(output.shape)
        found = (output, *torch.autograd.grad(output, (points, table), upstream))
        plain = torch_reference.encode(points, segments, table, offsets, levels)
        expected = (plain, *torch.autograd.grad(plain, (points, table), upstream))
        for name, one, other in zip(("values", "point gradient", "table gradient"), found, expected, strict=True):
            errors[f"{name}, {features} features"] = _error(one, other)
    return errors | _other_hash_cases()


def _other_hash_cases() -> dict[str, float]:
    points, segments, table, offsets, levels = _arguments(3, 4)
    expected = torch_reference.encode(points, segments, table, offsets, levels)
    cut = encode(points, segments, table, offsets, levels, launch=Launch(points=16, levels=1, warps=1))
    copy = table.half()
    half = encode(points, segments, torch.zeros_like(table), offsets, levels, copy)
    expected_half = torch_reference.encode(points, segments, copy.float(), offsets, levels).half()
    stray = torch.tensor([[1.0, 1.0, 1.0], [float("nan"), 0.5, 0.5]])
    bounds = torch.tensor([0, 1, 1, 2])
    gradient = torch.autograd.grad(
        hash_encode(stray, bounds, table.requires_grad_(), offsets, levels).nan_to_num().sum(), table
    )[0]
    none = encode(points[:0], torch.zeros_like(segments), table.detach(), offsets, levels)
    return {
        "values, smaller blocks": _error(cut, expected),
        "values, half copy": _error(half, expected_half),
        "rows beyond the table": float(gradient.shape != table.shape),
        "rows of no points": float(none.shape != (0, 12)),
    }


def _arguments(level_count: int, features: int) -> tuple[Tensor, ...]:
    """Points of three sub-fields, one of them empty, and a table with dense and hashed levels."""
    settings = GridSettings(
        levels=level_count, features_per_level=features, min_resolution=3, max_resolution=40, log2_rows=8
    )
    layout = grid_layout(settings, 3)
    assert set(layout.hashed) == {True, False}
    points, segments = torch.rand(POINTS, 3), torch.tensor([0, 30, 30, POINTS])
    return points, segments, torch.randn(layout.table_rows, features), layout.offsets(), layout.levels()


def _error(found: Tensor, expected: Tensor) -> float:
    """The length of the difference, as a share of the expected length."""
    assert found.shape == expected.shape
    assert found.dtype == expected.dtype
    return float((found.float() - expected.float()).norm() / expected.float().norm())


def mlp_cases() -> dict[str, float]:
    """Errors of the sub-fields' networks and their gradients against a loop of linear layers."""
    errors = {}
    for widths, dtype in (
        ((8, 20, 1), torch.float32),
        ((40, 64, 80), torch.float16),
        ((47, 16, 16, 3), torch.float32),
        ((47, 16, 16, 3), torch.float16),
    ):
        network = SubFieldMlp(3, widths)
        network.dtype = dtype
        assignment = Assignment(torch.tensor([0, 70, 70, 1200]))  # the last one needs two programs on the way back
        inputs = torch.randn(1200, widths[0], requires_grad=True)
        output = network(inputs, assignment)
        plain = network.blockwise(inputs, assignment.bounds)
        upstream = torch.randn_like(output)
        wanted = (inputs, *network.parameters())
        found, expected = (torch.autograd.grad(values, wanted, upstream) for values in (output, plain))
        name = f"{widths} {str(dtype).removeprefix('torch.')}"
        errors[f"{name} values"] = _error(output, plain)
        errors[f"{name} gradients"] = max(_error(*pair) for pair in zip(found, expected, strict=True))
    return errors


PARTS: dict[str, Callable[[], dict[str, float]]] = {"hash": hash_cases, "mlp": mlp_cases}

if __name__ == "__main__":
    torch.manual_seed(0)
    print(json.dumps(PARTS[sys.argv[1]]()))
