"""How presight_perception answers each golden case: one function a case, named after its file."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from presight_perception import map_truth, metrics
from presight_perception.bev_pooling import PoolingGrid, bev_pool
from presight_perception.deformable_attention import deformable_attention
from presight_perception.fusion import Fusion2DSettings, Fusion3DSettings, PriorFusion2D, PriorFusion3D
from presight_perception.metrics.polyline import chamfer_m, resample
from presight_perception.metrics.vector_precision import ScoredLines, VectorPrecision, VectorSettings
from presight_perception.occupancy_truth import OccupancyTruth
from presight_perception.voxelise import BevAugmentation, VoxelGrid, inside_range, voxelise, voxelise_tensors
from tests.golden.cases import Check, absolute, equal, of_maximum

Golden = Mapping[str, Any]


def vector_ap(golden: Golden) -> list[Check]:
    checks = [check for case in golden["cases"] for check in _vector_case(case)]
    for number, pair in enumerate(golden["chamfer_pairs"]):
        a, b = (resample(np.array(pair[name]), 200) for name in "ab")
        checks += [
            absolute(f"chamfer {number}", chamfer_m(a, b), pair["chamfer_scalar"], 5e-9),
            absolute(f"resampled {number}", a[:5], pair["a_resampled_first5"], 5e-9),
            absolute(f"resampled {number}, middle", a[100], pair["a_resampled_index100"], 5e-9),
        ]
    return checks


def maptr_tpfp(golden: Golden) -> list[Check]:
    checks = []
    for case in range(int(golden["num_cases"])):
        predicted, scores, true = (golden[f"case{case}_{name}"] for name in ("pred", "scores", "gt"))
        precision = VectorPrecision(metrics.MAPTR_SETTINGS)
        label = metrics.MAPTR_SETTINGS.classes.index("divider")
        lines = ScoredLines(list(predicted), np.full(len(scores), label), scores)
        found = precision.add(lines, {"divider": list(true)})["divider"]
        for column, threshold in enumerate(metrics.MAPTR_SETTINGS.thresholds_m):
            checks += [
                equal(f"case {case} true at {threshold}", found[:, column], golden[f"case{case}_tp_{threshold}"]),
                equal(f"case {case} false at {threshold}", ~found[:, column], golden[f"case{case}_fp_{threshold}"]),
            ]
        if f"case{case}_score_matrix" in golden:
            expected = -golden[f"case{case}_score_matrix"]
            distances = np.array([[chamfer_m(a, b) for b in true] for a in predicted])
            near = expected < 100  # beyond MapTR's gate, which this project has no use for
            checks.append(absolute(f"case {case} chamfer", distances[near], expected[near], 5e-9))
    return checks


def raster_iou(golden: Golden) -> list[Check]:
    classes = tuple(str(name) for name in golden["class_names"])
    masks = {
        "": (golden["logits"] > 0, golden["gt_mask"]),
        "absent_": (golden["absent_pred_mask"], golden["absent_gt_mask"]),
    }
    checks = [equal("predicted masks", golden["logits"] > 0, golden["pred_mask"])]
    for prefix, (predicted, true) in masks.items():
        iou = metrics.RasterIou(classes)
        for sample in zip(predicted, true, strict=True):
            iou.add(*sample)
        scores = iou.result()
        checks += [
            absolute(f"{prefix}iou", list(scores.per_class.values()), golden[f"{prefix}iou"], 5e-12),
            absolute(f"{prefix}mean", scores.mean, golden[f"{prefix}miou"], 5e-12),
        ]
    return checks


def rasterize_map(golden: Golden) -> list[Check]:
    checks = []
    for sample, expected in enumerate(golden["masks"]):
        lines: map_truth.MapLines = {name: [] for name in map_truth.MAP_CLASSES}
        for row in np.flatnonzero(golden["line_sample"] == sample):
            first, end = golden["offsets"][row : row + 2]
            lines[map_truth.MAP_CLASSES[golden["line_class"][row]]].append(golden["points"][first:end])
        masks = map_truth.rasterise(lines, map_truth.MapTruthSettings(), map_truth.RasterSettings())
        checks.append(equal(f"sample {sample}", masks, expected))
    return checks


def occ_miou(golden: Golden) -> list[Check]:
    checks = []
    masks: tuple[tuple[metrics.Mask, str], ...] = (("camera", "camera"), ("lidar", "lidar"), ("none", "nomask"))
    for mask, name in masks:
        iou = metrics.OccupancyIou(mask)
        truths = zip(golden["semantics"], golden["mask_camera"], golden["mask_lidar"], strict=True)
        for predicted, truth in zip(golden["pred"], truths, strict=True):
            iou.add(predicted, OccupancyTruth(*truth))
        scores = iou.result()
        found, expected = np.array(list(scores.per_class.values())), golden[f"iou_{name}"]
        mean = scores.mean(absent="zero if predicted")
        checks += [
            equal(f"{name} histogram", scores.histogram, golden[f"hist_{name}"]),
            equal(f"{name} undefined", np.isnan(found), np.isnan(expected)),
            absolute(f"{name} iou", np.nan_to_num(found), np.nan_to_num(expected), 5e-12),
            absolute(f"{name} mean", mean, golden[f"miou_{name}"], 5e-12),
            equal(f"{name} printed", round(100 * mean, 2), golden[f"overall_rounded_{name}"]),
        ]
    return checks


def voxelize_prior(golden: Golden) -> list[Check]:
    low, high = np.split(golden["pc_range"], 2)
    grid = VoxelGrid(tuple(low), tuple(high), tuple(golden["voxel_size"]))
    checks = []
    for case in ("noaug", "flip_dx", "flip_dy", "rot_scale_flip", "nofeat", "empty"):
        points, features, hits = _prior_points(golden, case, grid)
        found = voxelise(points, features, hits, grid)
        tensors = (None if part is None else torch.from_numpy(np.asarray(part)) for part in (points, features, hits))
        for name, (channels, coordinates) in {"numpy": found, "torch": voxelise_tensors(*tensors, grid)}.items():
            checks += [
                equal(f"{case} coordinates, {name}", coordinates, golden[f"{case}/prior_voxels_coords"]),
                absolute(f"{case} voxels, {name}", channels, golden[f"{case}/prior_voxels"], 1e-6),
            ]
    return checks


def prior_fusion_2d(golden: Golden) -> list[Check]:
    weights = _weights(golden)
    sizes = {
        "grid": _fusion_grid(golden),
        "hidden_channels": len(weights["block1.0.bias"]),
        "bev_channels": len(weights["block2.0.bias"]),
    }
    plain = PriorFusion2D(Fusion2DSettings(**sizes))
    residual = PriorFusion2D(Fusion2DSettings(**sizes, residual=True))
    fused = _fused(golden, residual, weights)
    return [
        *_fusion_checks(golden, plain, weights, "out/default"),
        absolute("residual", fused, golden["out/residual"], 1.5e-5),
    ]


def prior_fusion_3d(golden: Golden) -> list[Check]:
    weights, bev = _weights(golden), golden["in/bev_feats"]
    settings = Fusion3DSettings(
        grid=_fusion_grid(golden),
        hidden_channels=len(weights["voxel_feature_extractor.0.bias"]),
        flat_channels=len(weights["block1.0.bias"]),
        bev_channels=bev.shape[1],
        heights=bev.shape[4],
    )
    return _fusion_checks(golden, PriorFusion3D(settings), weights, "out/default")


def msda(golden: Golden) -> list[Check]:
    shapes = [(int(height), int(width)) for height, width in golden["spatial_shapes"]]
    names = ("value", "sampling_locations", "attention_weights")
    given = [torch.from_numpy(golden[name]).requires_grad_() for name in names]
    exact = [tensor.detach().double() for tensor in given]
    output = deformable_attention(given[0], shapes, given[1], given[2])
    output.backward(torch.from_numpy(golden["grad_output"]))
    checks = [
        absolute("output", output, golden["output"], 2.5e-6),
        absolute(
            "output, float64", deformable_attention(exact[0], shapes, exact[1], exact[2]), golden["output_f64"], 5e-14
        ),
    ]
    for name, tensor in zip(names, given, strict=True):
        assert tensor.grad is not None
        found, expected = tensor.grad.numpy().copy(), golden[f"grad_{name}"].copy()
        if name == "sampling_locations":
            found[0, 0, 0, 0, 2] = expected[0, 0, 0, 0, 2] = 0  # on a line of cell centres the slope is one-sided
        checks.append(of_maximum(f"gradient of {name}", found, expected, 2e-6))
    return checks


def bev_pool_case(golden: Golden) -> list[Check]:
    low, voxel, shape = (golden[f"grid_{name}"].tolist() for name in ("lower_bound", "interval", "size_xyz"))
    depth, features = (torch.from_numpy(golden[name]).requires_grad_() for name in ("depth", "feat"))
    grid = PoolingGrid(tuple(low), tuple(voxel), tuple(shape))
    output = bev_pool(torch.from_numpy(golden["coor_metres"]), depth, features, grid)
    output.backward(torch.from_numpy(golden["grad_output"]))
    return [
        absolute("output", output, golden["output"], 5e-6),
        absolute("gradient of depth", depth.grad, golden["grad_depth"], 5e-6),
        absolute("gradient of features", features.grad, golden["grad_feat"], 5e-6),
    ]


PERCEPTION_ADAPTERS: dict[str, Callable[[Golden], list[Check]]] = {
    "vector_ap": vector_ap,
    "maptr_tpfp": maptr_tpfp,
    "raster_iou": raster_iou,
    "rasterize_map": rasterize_map,
    "occ_miou": occ_miou,
    "voxelize_prior_mapping": voxelize_prior,
    "voxelize_prior_occupancy": voxelize_prior,
    "prior_fusion_2d": prior_fusion_2d,
    "prior_fusion_3d_bevdet": prior_fusion_3d,
    "prior_fusion_3d_fbocc": prior_fusion_3d,
    "msda": msda,
    "bev_pool": bev_pool_case,
}


def _vector_case(case: Golden) -> list[Check]:
    name, expected = case["name"], case["expected"]
    settings = VectorSettings.for_range(*(float(side) for side in case["roi_size"]))
    classes = tuple(sorted(case["class_to_id"], key=case["class_to_id"].get))
    precision = VectorPrecision(VectorSettings(settings.thresholds_m, settings.point_count, classes))
    checks = [equal(f"{name} thresholds", settings.thresholds_m, expected["thresholds"])]
    for token, sample in case["samples"].items():
        found = precision.add(_scored_lines(sample["pred"]), _arrays(sample["gt"]))
        for class_name, by_threshold in expected["tp_per_sample"][token].items():
            columns = np.array(list(by_threshold.values()), np.bool_).reshape(len(settings.thresholds_m), -1)
            checks.append(equal(f"{name} {token} {class_name} found", found[class_name], columns.T))
    scores = precision.result()
    for class_name in classes:
        own = list(scores.per_threshold[class_name].values())
        listed = list(expected["AP_per_threshold"][class_name].values())
        checks += [
            absolute(f"{name} {class_name} by threshold", own, listed, 5e-12),
            absolute(f"{name} {class_name}", scores.per_class[class_name], expected["AP"][class_name], 5e-12),
            equal(f"{name} {class_name} count", precision.true_count[class_name], expected["num_gts"][class_name]),
        ]
    return [*checks, absolute(f"{name} mean", scores.mean, expected["mAP"], 5e-12)]


def _scored_lines(predicted: Mapping[str, Any] | None) -> ScoredLines:
    if predicted is None:
        return ScoredLines.none()
    lines = [np.array(line, np.float64) for line in predicted["vectors"]]
    return ScoredLines(lines, np.array(predicted["labels"], np.int64), np.array(predicted["scores"], np.float64))


def _arrays(lines: Mapping[str, list[Any]]) -> dict[str, list[NDArray]]:
    return {name: [np.array(line, np.float64) for line in group] for name, group in lines.items()}


def _prior_points(golden: Golden, case: str, grid: VoxelGrid) -> tuple[NDArray, NDArray | None, NDArray]:
    """Points, features and hits of one case: outside ones dropped first, then augmented, as released."""
    plain = {"nofeat": "noaug", "empty": "noaug"}.get(case, case)
    count = 0 if case == "empty" else int(golden[f"{plain}/num_input_points"])
    rotation_deg, scale, flip_x, flip_y = golden[f"{plain}/aug"]
    points, features, hits = (golden[name][:count] for name in ("xyz", "features", "hits"))
    inside = inside_range(points, grid)
    augmentation = BevAugmentation(np.deg2rad(rotation_deg), scale, bool(flip_x), bool(flip_y))
    return points[inside] @ augmentation.matrix.T, None if case == "nofeat" else features[inside], hits[inside]


def _fusion_grid(golden: Golden) -> VoxelGrid:
    low, high = np.split(golden["cfg/pc_range"], 2)
    return VoxelGrid(tuple(low), tuple(high), tuple(golden["cfg/voxel_size"]))


def _weights(golden: Golden) -> dict[str, torch.Tensor]:
    return {name[2:]: torch.from_numpy(golden[name]) for name in golden if name.startswith("w/")}


def _fusion_inputs(golden: Golden) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    samples = range(len(golden["in/bev_feats"]))
    voxels = np.concatenate([golden[f"in/prior_voxels_{sample}"] for sample in samples])
    coordinates = [
        np.pad(golden[f"in/prior_voxels_coords_{sample}"], ((0, 0), (1, 0)), constant_values=sample)
        for sample in samples
    ]
    inputs = (golden["in/bev_feats"], voxels, np.concatenate(coordinates).astype(np.int64))
    bev, features, places = (torch.from_numpy(array) for array in inputs)
    return bev, features, places


def _fused(golden: Golden, module: torch.nn.Module, weights: dict[str, torch.Tensor]) -> torch.Tensor:
    module.load_state_dict(weights)
    return module.eval()(*_fusion_inputs(golden))


def _fusion_checks(
    golden: Golden, module: PriorFusion2D | PriorFusion3D, weights: dict[str, torch.Tensor], output: str
) -> list[Check]:
    seen: dict[str, torch.Tensor] = {}
    module.block1.register_forward_hook(lambda *call: seen.update(block1=call[2]))
    fused = _fused(golden, module, weights)
    first = module.voxel_feature_extractor(torch.from_numpy(golden["in/prior_voxels_0"]))
    return [
        absolute("voxel layers", first, golden["mid/voxel_mlp_out_0"], 1.5e-5),
        absolute("block 1", seen["block1"], golden["mid/block1_out"], 1.5e-5),
        absolute("fused", fused, golden[output], 1.5e-5),
    ]
