"""The lidar points of past drives as a prior."""

import json
import pickle
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch.utils.data import DataLoader

from presight_core import frames
from presight_core.errors import InputError
from presight_core.grid import Lattice
from presight_perception.dataset import Place, PriorDataset, PriorSettings, collate
from presight_perception.fusion import Fusion2DSettings, PriorFusion2D
from presight_perception.lidar_history import VEHICLE_M, LidarHistory
from presight_perception.voxelise import VoxelGrid
from tests.tiny_dataset import TinyDataset

DRIVES = ("scene-0000", "scene-0001")
VERSION = "v1.0-mini"
GRID = VoxelGrid((-10.0, -6.0, -2.0), (10.0, 6.0, 6.0), (0.5, 0.5, 0.5))
RANGES = ((-10.0, 10.0), (-6.0, 6.0), (-2.0, 6.0))
POSE = frames.planar_transform(4.0, -3.0, 0.7)


def cloud(seed: int) -> np.ndarray:
    """Points around the world's origin, some voxels with several."""
    return np.random.default_rng(seed).uniform((-25, -25, -1), (25, 25, 2), (6000, 3))


def write(tiny: TinyDataset, world_points: Callable[[int], Any], yaw_rad: float = 0.0) -> dict[str, list[np.ndarray]]:
    """Write tables and sweeps in which row i of the lidar's files sees some world points; each drive's keyframes.

    All sweeps are taken from 100 m above the origin, so that no point is the own vehicle's.
    """
    world_from_ego = frames.planar_transform(0, 0, yaw_rad)
    world_from_ego[2, 3] = 100.0
    for pose in tiny.tables["ego_pose"]:
        pose["rotation"] = frames.quaternion_from_rotation(world_from_ego[:3, :3]).tolist()
        pose["translation"] = world_from_ego[:3, 3].tolist()
    mounted = next(row for row in tiny.tables["calibrated_sensor"] if row["sensor_token"] == "sensor-LIDAR_TOP")
    ego_from_lidar = frames.transform(frames.rotation_from_quaternion(mounted["rotation"]), mounted["translation"])
    seen: dict[str, list[np.ndarray]] = defaultdict(list)
    rows = [row for row in tiny.tables["sample_data"] if "LIDAR_TOP" in row["filename"]]
    for number, row in enumerate(rows):
        points = np.asarray(world_points(number), np.float64).reshape(-1, 3)
        write_sweep(tiny.root / row["filename"], frames.apply(frames.invert(world_from_ego @ ego_from_lidar), points))
        if row["is_key_frame"]:
            seen[f"scene-000{row['sample_token'].split('-')[1]}"].append(points)
    tiny.write_tables()
    return seen


def write_sweep(file: Path, points_lidar: np.ndarray) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    np.pad(points_lidar, ((0, 0), (0, 2))).astype("<f4").tofile(file)


def keyframe_files(tiny: TinyDataset) -> list[Path]:
    rows = tiny.tables["sample_data"]
    return [tiny.root / row["filename"] for row in rows if "LIDAR_TOP" in row["filename"] and row["is_key_frame"]]


def history_of(tiny: TinyDataset, *drives: str) -> LidarHistory:
    return LidarHistory.from_tables(tiny.root, VERSION, drives or DRIVES)


def test_a_window_holds_the_mean_of_each_voxel_and_drive(tiny):
    seen = write(tiny, cloud, yaw_rad=0.3)
    hits: dict[tuple, list[np.ndarray]] = defaultdict(list)
    for drive, sweeps in seen.items():
        for point in np.concatenate(sweeps):
            hits[drive, *np.floor(point / 0.4).astype(int)].append(point)
    means = frames.apply(frames.invert(POSE), np.array([np.mean(points, 0) for points in hits.values()]))
    counts = np.array([len(points) for points in hits.values()])
    low, high = np.transpose(RANGES)
    inside = np.all((means >= low) & (means < high), -1)
    mean_hits = counts.sum() / len({key[1:] for key in hits})
    found = history_of(tiny).points(Place("toytown", POSE), RANGES)
    assert inside.sum() > 500
    assert counts.max() > 2
    distances_m, rows = cKDTree(found.points_ego).query(means[inside])
    assert distances_m.max() < 1e-4
    assert sorted(rows) == list(range(len(found.weights)))
    np.testing.assert_allclose(found.weights[rows], counts[inside] / mean_hits, rtol=1e-5)


def test_a_window_equals_the_same_box_of_the_whole_city(tiny):
    write(tiny, cloud)
    history = history_of(tiny)
    everywhere = history.points(Place("toytown", POSE), ((-90.0, 90.0),) * 3)
    inside = np.all((everywhere.points_ego >= -5) & (everywhere.points_ego < 5), -1)
    found = history.points(Place("toytown", POSE), ((-5.0, 5.0),) * 3)
    assert len(everywhere.weights) == len(history.cities["toytown"])
    assert 0 < inside.sum() < len(inside) / 4
    np.testing.assert_array_equal(found.points_ego, everywhere.points_ego[inside])


def test_only_keyframes_count(tiny):
    seen = write(tiny, lambda number: [[number, 0.5, 0.5]])
    found = history_of(tiny).cities["toytown"].points_world
    expected = np.concatenate([sweep for sweeps in seen.values() for sweep in sweeps])
    assert len(expected) == 4  # of eight
    np.testing.assert_allclose(np.sort(found[:, 0]), np.sort(expected[:, 0]), atol=1e-5)


def test_the_vehicle_does_not_see_itself(tiny):
    write(tiny, lambda number: [[2.0, 0.5, 101.5], [2.0, 1.5, 101.5], [-1.5, 0.5, 101.5]], yaw_rad=0.0)
    found = history_of(tiny).cities["toytown"].points_world
    np.testing.assert_allclose(np.unique(found[:, 0].round(3)), [-1.5, 2.0])
    np.testing.assert_allclose(found[found[:, 0] > 0, 1], 1.5, atol=1e-5)


def test_a_drive_left_out_leaves_what_the_others_saw(tiny):
    write(tiny, cloud)
    both, other = history_of(tiny), history_of(tiny, "scene-0001")
    left = both.points(Place("toytown", POSE, without_drives=("scene-0000", "scene-9999")), RANGES)
    alone = other.points(Place("toytown", POSE), RANGES)
    whole = both.points(Place("toytown", POSE), RANGES)
    assert 0 < len(left.weights) < len(whole.weights)
    np.testing.assert_array_equal(left.points_ego, alone.points_ego)
    np.testing.assert_allclose(left.weights / left.weights[0], alone.weights / alone.weights[0], rtol=1e-5)


def test_only_the_given_drives_are_in_it(tiny):
    write(tiny, cloud)
    assert history_of(tiny, "scene-0001").cities["toytown"].drives == ("scene-0001",)
    assert history_of(tiny).cities["toytown"].drives == DRIVES


def test_each_city_has_its_own_points(tiny):
    tiny.tables["log"].append({**tiny.tables["log"][0], "token": "log-1", "location": "village"})
    tiny.tables["scene"][1]["log_token"] = "log-1"
    seen = write(tiny, cloud)
    history = history_of(tiny)
    assert {city: points.drives for city, points in history.cities.items()} == {
        "toytown": DRIVES[:1],
        "village": DRIVES[1:],
    }
    assert history.cities["village"].hits.sum() == sum(map(len, seen["scene-0001"]))


def test_it_goes_the_way_of_every_prior(tiny):
    """Voxeliser, workers, collation and fusion; a lattice as fine as the grid shows that hits add up over drives."""
    write(tiny, cloud)
    history = LidarHistory.from_tables(tiny.root, VERSION, DRIVES, Lattice(voxel_m=0.1))
    dataset = PriorDataset(history, [Place("toytown", POSE), Place(None, POSE)], PriorSettings(GRID))
    (batch,) = DataLoader(dataset, batch_size=2, collate_fn=collate, num_workers=1)
    points = history.points(Place("toytown", POSE), RANGES)
    assert batch.voxels.shape[1] == 4 + history.channel_count == 4
    assert not batch.coordinates[:, 0].any()
    torch.testing.assert_close(batch.voxels[:, 3].exp().sum(), torch.tensor(points.weights.sum()), rtol=1e-4, atol=0)
    fusion = PriorFusion2D(Fusion2DSettings(GRID, voxel_channels=4, hidden_channels=4, bev_channels=4))
    bev = torch.zeros(2, 4, 12, 20)
    assert fusion(bev, batch.voxels, batch.coordinates).shape == bev.shape


def test_it_can_be_sent_to_another_process(tiny):
    write(tiny, cloud)
    history = history_of(tiny)
    sent = pickle.loads(pickle.dumps(history))  # noqa: S301
    place = Place("toytown", POSE)
    np.testing.assert_array_equal(sent.points(place, RANGES).points_ego, history.points(place, RANGES).points_ego)


def test_points_that_are_not_finite_are_passed_over(tiny):
    write(tiny, lambda number: [[1.0, 0.5, 0.5]])
    for file in keyframe_files(tiny):
        file.write_bytes(file.read_bytes() + np.array([np.nan, 0, 0, 0, 0, 0, np.inf, 0, 0, 0], "<f4").tobytes())
    assert len(history_of(tiny).cities["toytown"]) == len(DRIVES)


def test_a_city_without_drives_is_an_error(tiny):
    write(tiny, cloud)
    with pytest.raises(InputError, match=r"no drive was in 'village', only in \['toytown'\]"):
        history_of(tiny).points(Place("village", POSE), RANGES)


def test_a_drive_that_is_not_there_is_named(tiny):
    write(tiny, cloud)
    with pytest.raises(InputError, match="no LIDAR_TOP keyframes of scene-0007"):
        history_of(tiny, "scene-0001", "scene-0007")


def test_a_sweep_cut_short_is_named(tiny):
    write(tiny, cloud)
    file = keyframe_files(tiny)[0]
    file.write_bytes(file.read_bytes()[:-3])
    with pytest.raises(InputError, match=rf"{file.name}: 119997 bytes are no whole number of points"):
        history_of(tiny)


def test_a_missing_sweep_is_named(tiny):
    write(tiny, cloud)
    file = keyframe_files(tiny)[0]
    file.unlink()
    with pytest.raises(InputError, match=rf"{file.name}: No such file"):
        history_of(tiny)


@pytest.mark.parametrize(
    ("table", "field", "target"),
    [
        ("scene", "log_token", "log"),
        ("sample_data", "ego_pose_token", "ego_pose"),
        ("calibrated_sensor", "sensor_token", "sensor"),
    ],
)
def test_a_token_that_leads_nowhere_is_named(tiny, table, field, target):
    write(tiny, cloud)
    for row in tiny.tables[table]:
        row[field] = "nowhere"
    tiny.write_tables()
    with pytest.raises(InputError, match=rf"{target}\.json: no row has the token 'nowhere'"):
        history_of(tiny)


def test_a_real_sweep_lies_on_the_ground_without_its_vehicle(shared_data):
    history = LidarHistory.from_tables(shared_data / "nuscenes-keyframe", VERSION, ["scene-0061"])
    (city,) = history.cities
    pose = frames.transform(*real_pose(shared_data / "nuscenes-keyframe" / VERSION))
    near = history.points(Place(city, pose), ((-10.0, 10.0), (-10.0, 10.0), (-3.0, 5.0))).points_ego
    low, high = np.transpose(VEHICLE_M)
    own = np.all((near > low) & (near < high), -1)
    assert not own.any()
    assert len(near) > 500
    assert abs(np.median(near[:, 2])) < 0.2


def real_pose(folder: Path) -> tuple[np.ndarray, Any]:
    """Rotation and translation of the vehicle at the lidar's time."""
    files = json.loads((folder / "sample_data.json").read_text())
    (token,) = {row["ego_pose_token"] for row in files if "LIDAR_TOP" in row["filename"]}
    (pose,) = (row for row in json.loads((folder / "ego_pose.json").read_text()) if row["token"] == token)
    return frames.rotation_from_quaternion(pose["rotation"]), pose["translation"]
