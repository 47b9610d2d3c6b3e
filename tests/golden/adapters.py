"""How this project answers each golden case: one function a case, named after its file.

Tolerances are those of the golden values' README, five times the spread of two float implementations.
"""

import re
from collections.abc import Callable, Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from presight_core.config import GridSettings, TilingSettings
from presight_core.field import contraction, losses, rendering, samplers
from presight_core.field.assignment import assign
from presight_core.field.hash_encode import GridLayout, hash_encode
from presight_core.field.hash_encode.layout import level_resolutions
from presight_core.field.spherical_harmonics import spherical_harmonics
from stages.tiling import box_of
from tests.golden.cases import Check, absolute, equal, of_maximum, relative
from tests.golden.perception_adapters import PERCEPTION_ADAPTERS

Golden = Mapping[str, NDArray]
PULSE_WIDTHS = (0.03, 0.003)  # of the released code's interlevel loss
SKY_EXTREMES = 7  # accumulations at the head of the sky case, which the reference clips


def hash_encode_case(golden: Golden) -> list[Check]:
    log2_rows, features = int(golden["log2_hashmap_size"]), int(golden["features_per_level"])
    settings = GridSettings(
        levels=int(golden["num_levels"]),
        features_per_level=features,
        min_resolution=int(golden["min_res"]),
        max_resolution=int(golden["max_res"]),
        log2_rows=log2_rows,
    )
    resolutions = tuple(int(resolution) for resolution in golden["scalings"])
    rows, hashed = (1 << log2_rows,) * len(resolutions), (True,) * len(resolutions)
    layout = GridLayout(resolutions, rows, hashed, features, sub_field_count=1)
    points, table = _leaf(golden["points"]), _leaf(golden["hash_table"])
    segments = torch.tensor([0, len(points)])
    output = hash_encode(points, segments, table, layout.offsets(), layout.levels())
    output.backward(torch.from_numpy(golden["grad_output"]))
    scaled = golden["points"][:, None] * np.array(resolutions, np.float32)[:, None]
    on_lattice = (scaled == np.floor(scaled)).any((1, 2))  # there the slope is one-sided
    ordinary = ~(golden["on_lattice"] | on_lattice)
    return [
        equal("resolutions", level_resolutions(settings), resolutions),
        absolute("output", output, golden["output"], 1e-6),
        of_maximum("table gradient", table.grad, golden["grad_hash_table"], 1e-6),
        of_maximum("point gradient", points.grad[ordinary], golden["grad_points"][ordinary], 1e-6),
    ]


def spherical_harmonics_case(golden: Golden) -> list[Check]:
    return [
        absolute(result, spherical_harmonics(torch.from_numpy(golden[given])), golden[result], 1.5e-6)
        for given, result in (("directions", "sh_unit"), ("directions_01", "sh_of_directions_01"))
    ]


def scene_contraction(golden: Golden) -> list[Check]:
    x = _leaf(golden["x"])
    contracted = contraction.contract(x)
    contracted.backward(torch.from_numpy(golden["grad_output"]))
    largest = np.sort(np.abs(golden["x"]), 1)
    ordinary = largest[:, 2] > largest[:, 1]  # not the origin, nor a tie of the maximum norm
    low, high = torch.from_numpy(golden["aabb"])
    position, inside = contraction.grid_position(
        torch.from_numpy(golden["positions"]), (low + high) / 2, (high - low) / 2
    )
    slopes, expected = x.grad[ordinary].numpy(), golden["grad_x"][ordinary]
    upstream = np.abs(golden["grad_output"][ordinary]).max(1, keepdims=True)
    return [
        absolute("contracted", contracted, golden["contracted_linf"], 1.5e-6),
        absolute("gradient", slopes / upstream, expected / upstream, 2.5e-6),
        equal("selector", inside, golden["selector"]),
        absolute("grid position", position, golden["unit_masked"], 1.5e-6),
    ]


def piecewise_spacing(golden: Golden) -> list[Check]:
    checks = []
    x, s = torch.from_numpy(golden["x"]), torch.from_numpy(golden["s"])
    near, far = torch.from_numpy(golden["near"]), torch.from_numpy(golden["far"])
    for sampler, count, name in _numbered(golden, r"(sampler(\d+)_(thr.+))_starts"):
        threshold = float(name.removeprefix("thr"))
        edges = samplers.uniform_edges(len(near), int(count), None, near)
        metres = samplers.Spacing(near, far, threshold).metres(edges)
        starts, ends = golden[f"{sampler}_starts"], golden[f"{sampler}_ends"]
        spaced, inverse = golden[f"spacing_{name}"], golden[f"inverse_{name}"]
        checks += [
            absolute(f"{name} spacing", samplers.spacing_from_metres(x, threshold), spaced, 5e-7),
            relative(f"{name} metres", samplers.metres_from_spacing(s, threshold), inverse, 5e-7),
            absolute(f"{name} s", edges, golden[f"{sampler}_sdist"], 5e-7),
            relative(f"{name} starts", metres[:, :-1], starts, 5e-4),
            relative(f"{name} ends", metres[:, 1:], ends, 5e-4),
        ]
    return checks


def pdf_sampling(golden: Golden) -> list[Check]:
    edges, weights = torch.from_numpy(golden["spacing_bins"]), torch.from_numpy(golden["weights"])
    spacing = samplers.Spacing(torch.from_numpy(golden["near"]), torch.from_numpy(golden["far"]), 1.0)
    checks = []
    for (count,) in _numbered(golden, r"M(\d+)_new_only_spacing_bins"):
        new = samplers.resample(edges, weights, int(count), None, padding=0.01)
        both = torch.cat([edges, new], -1).sort(-1).values
        for name, found in ((f"M{count}_new_only", new), (f"M{count}_with_original", both)):
            metres = spacing.metres(found)
            checks += [
                absolute(f"{name} s", found, golden[f"{name}_spacing_bins"], 5e-6),
                relative(f"{name} starts", metres[:, :-1], golden[f"{name}_starts"], 5e-5),
                relative(f"{name} ends", metres[:, 1:], golden[f"{name}_ends"], 5e-5),
            ]
    for name, power, count in _numbered(golden, r"(anneal(.+)_M(\d+)_spacing_bins)"):
        found = samplers.resample(edges, weights ** float(power), int(count), None, padding=0.01)
        checks.append(absolute(f"anneal {power}", found, golden[name], 5e-6))
    return checks


def render_weights(golden: Golden) -> list[Check]:
    density, lengths = _leaf(golden["density"]), torch.from_numpy(golden["deltas"])
    weights = rendering.ray_weights(density, lengths)
    (slope,) = torch.autograd.grad(weights, density, torch.from_numpy(golden["grad_weights"]))
    middles = torch.from_numpy((golden["starts"] + golden["ends"]) / 2)
    found = rendering.expected_depth(rendering.ray_weights(density.double(), lengths.double()), middles.double())
    hit = golden["accumulation_f64"] > 0  # an empty ray has no depth; the reference gives its batch's minimum
    plain = rendering.expected_depth(rendering.ray_weights(density, lengths), middles)
    (depth_slope,) = torch.autograd.grad(plain, density, torch.from_numpy(golden["grad_expected_depth"]))
    within = (golden["expected_depth"] > middles[:, 0].numpy()) & (golden["expected_depth"] < middles[:, -1].numpy())
    ordinary = (golden["accumulation"] > 1e-3) & within  # float32 depths of nearly empty rays are rough
    checks = [
        absolute("weights", weights, golden["weights"], 1.5e-6),
        absolute("weights, float64", weights, golden["weights_f64"], 1.5e-6),
        absolute("accumulation", weights.sum(-1), golden["accumulation"], 1.5e-6),
        relative("expected depth", found[hit], golden["expected_depth_f64"][hit], 5e-5),
        of_maximum("gradient of weights", slope, golden["grad_density_from_weights"], 2.5e-5, axis=1),
        of_maximum(
            "gradient of depth", depth_slope[ordinary], golden["grad_density_from_expected_depth"][ordinary], 2.5e-5, 1
        ),
    ]
    for number, (name, threshold) in enumerate(_numbered(golden, r"(threshold_depth_(.+))")):
        index, _ = rendering.first_hit(torch.from_numpy(golden["weights"]), float(threshold.replace("p", ".")))
        depth = middles.gather(1, index[:, None])[:, 0]
        clear = golden["threshold_unambiguous"][number]
        checks.append(relative(name, depth[clear], golden[name][clear], 5e-5))
    return checks


def losses_case(golden: Golden) -> list[Check]:
    checks = [
        check
        for prefix in ("", "regular_", "smooth_")
        for dtype in (torch.float64, torch.float32)
        for check in _histogram_losses(golden, prefix, dtype)
    ]
    accumulation = _leaf(golden["sky_accumulation"])
    is_sky = torch.from_numpy(golden["sky_mask"]) > 0.5
    sky = losses.sky_loss(accumulation, is_sky)
    sky.backward()
    rendered, target = (torch.from_numpy(golden[f"semantic_{name}"]) for name in ("pred", "target"))
    return [
        *checks,
        relative("sky", sky, golden["sky_loss"], 5e-6),
        relative(
            "sky, interior",
            losses.sky_loss(accumulation[SKY_EXTREMES:], is_sky[SKY_EXTREMES:]),
            golden["sky_loss_interior"],
            5e-6,
        ),
        of_maximum("sky gradient", accumulation.grad, golden["grad_sky_accumulation"], 5e-6),
        relative("features", losses.feature_loss(rendered, target), golden["semantic_loss"], 5e-6),
    ]


def subfield_aabb(golden: Golden) -> list[Check]:
    checks = []
    for (case,) in _numbered(golden, r"(case\d+)_translations"):
        positions, labels = golden[f"{case}_translations"], golden[f"{case}_labels"]
        boxes = [box_of(positions[labels == number], TilingSettings()) for number in range(labels.max() + 1)]
        query, centroids = (torch.from_numpy(golden[f"{case}_{name}_scaled"]) for name in ("query", "centroids"))
        assignment = assign(query, centroids)
        numbers = torch.arange(len(centroids)).repeat_interleave(assignment.segments.diff())
        checks += [
            absolute(f"{case} boxes", boxes, golden[f"{case}_aabbs_metres"], 1e-3),
            equal(f"{case} nearest", assignment.restore(numbers), golden[f"{case}_query_subfield"]),
        ]
    return checks


ADAPTERS: dict[str, Callable[[Golden], list[Check]]] = {
    "hash_encode": hash_encode_case,
    "spherical_harmonics": spherical_harmonics_case,
    "scene_contraction": scene_contraction,
    "piecewise_spacing": piecewise_spacing,
    "pdf_sampling": pdf_sampling,
    "render_weights": render_weights,
    "losses": losses_case,
    "subfield_aabb": subfield_aabb,
    **PERCEPTION_ADAPTERS,
}


def adapter_of(case: str) -> Callable[[Golden], list[Check]] | None:
    """The adapter of a case; what follows its name (`hash_encode_L4F2T10`) tells sizes apart."""
    names = [name for name in ADAPTERS if case == name or case.startswith(f"{name}_")]
    return ADAPTERS[max(names, key=len)] if names else None


def _histogram_losses(golden: Golden, prefix: str, dtype: torch.dtype) -> list[Check]:
    """Distortion and both interlevel losses with their gradients, at one precision."""
    rows = golden["regular_rows"] if prefix == "regular_" else slice(None)
    source = "" if prefix == "regular_" else prefix
    edges = [torch.from_numpy(golden[f"{source}sdist_{i}"][rows]).to(dtype) for i in range(3)]
    weights = [_leaf(golden[f"{source}weights_{i}"][rows], dtype) for i in range(3)]
    suffix, value_tolerance, slope_tolerance = ("_f64", 5e-12, 5e-10) if dtype == torch.float64 else ("", 5e-5, 5e-4)
    label = f"{prefix}%s, {str(dtype).removeprefix('torch.')}"

    def levels(loss: Callable[..., Tensor], *extra: tuple[float, ...]) -> Tensor:
        own = [loss(edges[2], weights[2], edges[i], weights[i], *(values[i] for values in extra)) for i in range(2)]
        return torch.stack(own).sum()

    checks = []
    for i in range(2):
        reached = losses.blurred_cumulative(edges[2], weights[2].detach(), edges[i], PULSE_WIDTHS[i])
        name = f"{source}cdf_interp_{i}{suffix}"
        checks.append(absolute(label % f"blurred sum {i}", reached, golden[name][rows], value_tolerance))
    cases = {
        "distortion": (losses.distortion_loss(edges[2], weights[2]), (2,)),
        "interlevel": (levels(losses.interlevel_loss), (0, 1)),
        "z_interlevel": (levels(losses.blurred_interlevel_loss, PULSE_WIDTHS), (0, 1)),
    }
    for name, (value, parts) in cases.items():
        checks.append(relative(label % name, value, golden[f"{prefix}{name}{suffix}"], value_tolerance))
        slopes = torch.autograd.grad(value, [weights[part] for part in parts])
        for part, slope in zip(parts, slopes, strict=True):
            expected = golden[f"{prefix}grad_{name}_weights_{part}{suffix}"]
            checks.append(of_maximum(label % f"{name} gradient {part}", slope, expected, slope_tolerance))
    return checks


def _numbered(golden: Golden, pattern: str) -> list[tuple[str, ...]]:
    """The groups of a pattern in each of the names that match it wholly: sizes are those of the file."""
    return [match.groups() for name in golden if (match := re.fullmatch(pattern, name))]


def _leaf(values: NDArray, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.from_numpy(values).to(dtype).requires_grad_()
