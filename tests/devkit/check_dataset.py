"""Load a data set with the official nuScenes devkit and print, as one line of JSON, what it finds.

Usage: python check_dataset.py ROOT PICTURES. Needs the devkit and numpy only; draws into the folder PICTURES.
"""

import json
import sys
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from nuscenes.map_expansion.arcline_path_utils import discretize_lane, length_of_lane
from nuscenes.map_expansion.bitmap import BitMap
from nuscenes.map_expansion.map_api import NuScenesMap
from nuscenes.nuscenes import NuScenes
from nuscenes.utils.geometry_utils import BoxVisibility, view_points

FIRST_ACTOR = 1_000_000  # instance numbers from here on belong to road users
NEAR_M = 25.0  # boxes nearer than this cover enough pixels to compare outlines


def check_tables(nusc: NuScenes) -> dict:
    """Every image opens through the devkit in its stated size."""
    images = [row for row in nusc.sample_data if row["sensor_modality"] == "camera"]
    for row in images:
        path, _, intrinsic = nusc.get_sample_data(row["token"])
        assert plt.imread(path).shape == (row["height"], row["width"], 3), path
        assert intrinsic.shape == (3, 3), path
    speeds = [np.linalg.norm(nusc.box_velocity(row["token"])) for row in nusc.sample_annotation]
    return {
        "images": len(images),
        "scenes": len(nusc.scene),
        "boxes": len(nusc.sample_annotation),
        "lidar_sweeps": sum(row["channel"] == "LIDAR_TOP" for row in nusc.sample_data),
        "fastest_box_mps": float(np.nanmax(speeds)),
    }


def check_boxes(nusc: NuScenes, root: Path) -> dict:
    """Compare the outline of each well visible box with the pixels of the object at its centre."""
    hits, overlaps = [], []
    for row in nusc.sample_data:
        if row["sensor_modality"] != "camera" or not row["is_key_frame"]:
            continue
        scene = nusc.get("scene", nusc.get("sample", row["sample_token"])["scene_token"])
        with np.load(root / "synth_gt" / scene["name"] / f"{row['timestamp']}_{row['channel']}.npz") as truth:
            instances = truth["instances"]
        _, boxes, intrinsic = nusc.get_sample_data(row["token"], box_vis_level=BoxVisibility.ALL)
        for box in boxes:
            visibility = nusc.get("sample_annotation", box.token)["visibility_token"]
            if not box.name.startswith("vehicle") or visibility != "4" or box.center[2] > NEAR_M:
                continue
            u, v, _ = view_points(box.center[:, None], intrinsic, normalize=True)[:, 0]
            instance = instances[int(v), int(u)]
            hits.append(bool(instance >= FIRST_ACTOR))
            if hits[-1]:
                corners = view_points(box.corners(), intrinsic, normalize=True)[:2]
                overlaps.append(_overlap(np.r_[corners.min(1), corners.max(1)], instances == instance))
    return {"checked": len(hits), "hits": sum(hits), "overlap": float(np.median(overlaps)) if overlaps else None}


def _overlap(box: np.ndarray, mask: np.ndarray) -> float:
    """Intersection over union of a box (left, top, right, bottom) and the bounding box of a mask."""
    rows, columns = np.nonzero(mask)
    other = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
    sides = np.maximum(np.minimum(box[2:], other[2:]) - np.maximum(box[:2], other[:2]), 0)
    areas = [np.prod(b[2:] - b[:2]) for b in (box, other)]
    return float(np.prod(sides) / (sum(areas) - np.prod(sides)))


def draw_samples(nusc: NuScenes, pictures: Path) -> dict:
    """Draw a sample as the tutorial does; with a lidar also what needs one."""
    sample = nusc.sample[len(nusc.sample) // 2]
    nusc.render_sample(sample["token"], out_path=str(pictures / "sample.png"), verbose=False)
    front = sample["data"]["CAM_FRONT"]
    nusc.render_sample_data(front, out_path=str(pictures / "front.png"), verbose=False)
    plt.close("all")
    lidar = sample["data"].get("LIDAR_TOP")
    if lidar is None:
        return {"lidar_points_in_image": None}
    nusc.render_sample_data(lidar, underlay_map=True, out_path=str(pictures / "lidar.png"), verbose=False)
    nusc.render_pointcloud_in_image(sample["token"], out_path=str(pictures / "points.png"), verbose=False)
    nusc.render_egoposes_on_map(nusc.log[0]["location"], out_path=str(pictures / "poses.png"))
    plt.close("all")
    points, _, _ = nusc.explorer.map_pointcloud_to_image(lidar, front)
    return {"lidar_points_in_image": int(points.shape[1])}


def ego_places(nusc: NuScenes) -> np.ndarray:
    """x, y and yaw (K, 3) of the car at every image."""
    rows = []
    for image in nusc.sample_data:
        pose = nusc.get("ego_pose", image["ego_pose_token"])
        w, _, _, z = pose["rotation"]
        rows.append([*pose["translation"][:2], 2 * np.arctan2(z, w)])
    return np.array(rows)


def check_layers(nusc_map: NuScenesMap, places: np.ndarray) -> dict:
    """Masks, geometries and point queries; the mask's pixel under a car is compared with the query."""
    middle = np.array(nusc_map.canvas_edge) / 2
    size = max(nusc_map.canvas_edge)
    layers = [name for name in nusc_map.non_geometric_layers if name != "traffic_light"]  # it has no mask
    mask = nusc_map.get_map_mask((*middle, size, size), 0, layers, (int(4 * size), int(4 * size)))
    drivable = mask[layers.index("drivable_area")]
    columns, rows = (places[:, :2] * 4).astype(int).T
    on_point = [nusc_map.layers_on_point(x, y) for x, y, _ in places]
    patch = (0, 0, *nusc_map.canvas_edge)
    within = nusc_map.get_records_in_patch(patch, mode="within")
    for name, tokens in within.items():
        for record in (nusc_map.get(name, token) for token in tokens):
            if "polygon_token" in record:
                assert nusc_map.extract_polygon(record["polygon_token"]).is_valid, (name, record["token"])
            elif "line_token" in record:
                assert nusc_map.extract_line(record["line_token"]).length > 0, (name, record["token"])
    lights = [nusc_map.get("stop_line", token)["cue"] for token in within["stop_line"]]
    return {
        "mask_pixels": {name: int(channel.sum()) for name, channel in zip(layers, mask, strict=True)},
        "records_within": {name: len(tokens) for name, tokens in within.items()},
        "drivable_share": float(drivable[rows, columns].mean()),
        "on_drivable_share": float(np.mean([bool(found["drivable_area"]) for found in on_point])),
        "on_segment_share": float(np.mean([bool(found["road_segment"]) for found in on_point])),
        "stop_line_cues": sorted({len(cue) for cue in lights}),
    }


def check_lanes(nusc_map: NuScenesMap, places: np.ndarray) -> dict:
    """The closest lane lies under the car and points its way; ends of connected lanes meet."""
    off_m, off_rad = [], []
    for x, y, yaw in places:
        lane = nusc_map.get_closest_lane(x, y, radius=2)
        poses = np.array(discretize_lane(nusc_map.get_arcline_path(lane), 0.05))
        distance = np.linalg.norm(poses[:, :2] - [x, y], axis=1)
        off_m.append(float(distance.min()))
        turn = poses[distance.argmin(), 2] - yaw
        off_rad.append(abs(float(np.arctan2(np.sin(turn), np.cos(turn)))))
    records = nusc_map.lane + nusc_map.lane_connector
    poses = nusc_map.discretize_lanes([record["token"] for record in records], 0.5)
    gaps_m, kinks_rad, outside_m = [0.0], [0.0], []
    for record in records:
        token = record["token"]
        ends = np.array(poses[token])
        polygon = nusc_map.extract_polygon(record["polygon_token"])
        outline = np.array(polygon.exterior.coords)
        assert polygon.is_valid
        outside_m.append(float(_middle_error_m(ends[len(ends) // 2, :2], outline)))
        for following in nusc_map.get_outgoing_lane_ids(token):
            assert token in nusc_map.get_incoming_lane_ids(following), (token, following)
            start = np.array(poses[following][0])
            gaps_m.append(float(np.linalg.norm(start[:2] - ends[-1, :2])))
            turn = start[2] - ends[-1, 2]
            kinks_rad.append(abs(float(np.arctan2(np.sin(turn), np.cos(turn)))))
    lengths = [length_of_lane(nusc_map.get_arcline_path(record["token"])) for record in nusc_map.lane]
    unconnected = [name for name, ends in nusc_map.connectivity.items() if not (ends["incoming"] and ends["outgoing"])]
    return {
        "lanes": len(nusc_map.lane),
        "connectors": len(nusc_map.lane_connector),
        "ego_off_lane_m": [float(np.median(off_m)), max(off_m)],
        "ego_off_lane_rad": [float(np.median(off_rad)), max(off_rad)],
        "joint_gap_m": max(gaps_m),
        "joint_kink_rad": max(kinks_rad),
        "middle_error_m": max(outside_m),
        "shortest_lane_m": min(lengths),
        "unconnected": len(unconnected),
    }


def _middle_error_m(place: np.ndarray, outline: np.ndarray) -> float:
    """How unequal a place's distances are to an outline's nearest points on its left and right: 0 in the middle."""
    a, b = outline[:-1], outline[1:]
    share = np.clip(((place - a) * (b - a)).sum(1) / np.maximum(((b - a) ** 2).sum(1), 1e-12), 0, 1)
    offsets = a + share[:, None] * (b - a) - place
    first = offsets[np.linalg.norm(offsets, axis=1).argmin()]
    opposite = offsets[offsets @ first < 0]
    return abs(float(np.linalg.norm(opposite, axis=1).min() - np.linalg.norm(first))) / 2


def draw_map(nusc: NuScenes, nusc_map: NuScenesMap, pictures: Path) -> None:
    """Draw the map, and the map into an image."""
    base, prior = (BitMap(nusc.dataroot, nusc_map.map_name, layer) for layer in ("basemap", "semantic_prior"))
    figure, _ = nusc_map.render_layers(nusc_map.non_geometric_layers, figsize=8, bitmap=prior)
    figure.savefig(pictures / "layers.png", bbox_inches="tight")
    figure, _ = nusc_map.render_centerlines(0.5, figsize=8, bitmap=base)
    figure.savefig(pictures / "centre_lines.png", bbox_inches="tight")
    sample = nusc.sample[len(nusc.sample) // 2]
    layers = ["road_segment", "ped_crossing", "walkway", "stop_line"]
    nusc_map.render_map_in_image(
        nusc, sample["token"], layer_names=layers, min_polygon_area=10, verbose=False,
        out_path=str(pictures / "map_in_image.png"),
    )  # fmt: skip
    x, y = nusc.ego_pose[0]["translation"][:2]
    nusc_map.render_map_mask((x, y, 60, 60), 30, None, (300, 300), figsize=(12, 6))
    if "LIDAR_TOP" in sample["data"]:
        nusc_map.render_egoposes_on_fancy_map(nusc, verbose=False, out_path=str(pictures / "poses_on_map.png"))
    plt.close("all")


def main(root: Path, pictures: Path) -> None:
    pictures.mkdir(parents=True, exist_ok=True)
    nusc = NuScenes("v1.0-mini", str(root), verbose=False)
    nusc_map = NuScenesMap(str(root), nusc.log[0]["location"])
    places = ego_places(nusc)
    report = {
        "tables": check_tables(nusc),
        "boxes": check_boxes(nusc, root),
        "samples": draw_samples(nusc, pictures),
        "layers": check_layers(nusc_map, places),
        "lanes": check_lanes(nusc_map, places),
    }
    draw_map(nusc, nusc_map, pictures)
    print(json.dumps(report))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
