"""Synthetic data sets: complete tables, true poses, resumable and reproducible files."""

import json
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest

from presight_core.cameras import Camera, pixel_centres
from presight_core.errors import SettingsError
from presight_core.frames import rotation_from_quaternion, transform
from presight_core.progress import Progress
from presight_core.synthetic import load_preset, write_dataset
from presight_core.synthetic.actors import FIRST_ACTOR
from presight_core.synthetic.nuscenes import TABLES

SMALL = ("keyframes=3", "width_px=96", "height_px=54")
TINY = load_preset("ci", SMALL)
VERSION = TINY.version
Tables = dict[str, list[dict]]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("synth")
    write_dataset(folder, TINY, seed=5, threads=2)
    return folder


@pytest.fixture(scope="module")
def tables(root: Path) -> Tables:
    return {table: json.loads((root / VERSION / f"{table}.json").read_text()) for table in TABLES}


def files_of(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def camera_of(tables: Tables, image: dict) -> Camera:
    pose = next(row for row in tables["ego_pose"] if row["token"] == image["ego_pose_token"])
    mount = next(row for row in tables["calibrated_sensor"] if row["token"] == image["calibrated_sensor_token"])
    world_from_ego, ego_from_camera = (
        transform(rotation_from_quaternion(row["rotation"]), row["translation"]) for row in (pose, mount)
    )
    return Camera(
        np.array(mount["camera_intrinsic"]), world_from_ego @ ego_from_camera, image["width"], image["height"]
    )


def truth_of(root: Path, tables: Tables, image: dict) -> dict[str, np.ndarray]:
    sample = next(row for row in tables["sample"] if row["token"] == image["sample_token"])
    scene = next(row for row in tables["scene"] if row["token"] == sample["scene_token"])
    channel = image["filename"].split("/")[1]
    with np.load(root / "synth_gt" / scene["name"] / f"{image['timestamp']}_{channel}.npz") as truth:
        return dict(truth)


def test_every_token_is_unique_and_every_reference_has_a_target(tables: Tables):
    tokens = {table: {row["token"] for row in rows} for table, rows in tables.items()}
    assert all(len(tokens[table]) == len(rows) for table, rows in tables.items())
    references = [
        ("scene", "log_token", "log"), ("scene", "first_sample_token", "sample"),
        ("scene", "last_sample_token", "sample"), ("sample", "scene_token", "scene"),
        ("sample", "prev", "sample"), ("sample", "next", "sample"), ("sample_data", "sample_token", "sample"),
        ("sample_data", "ego_pose_token", "ego_pose"), ("sample_data", "prev", "sample_data"),
        ("sample_data", "calibrated_sensor_token", "calibrated_sensor"), ("sample_data", "next", "sample_data"),
        ("calibrated_sensor", "sensor_token", "sensor"), ("sample_annotation", "sample_token", "sample"),
        ("sample_annotation", "instance_token", "instance"), ("sample_annotation", "prev", "sample_annotation"),
        ("sample_annotation", "next", "sample_annotation"), ("sample_annotation", "visibility_token", "visibility"),
        ("instance", "category_token", "category"), ("instance", "first_annotation_token", "sample_annotation"),
        ("instance", "last_annotation_token", "sample_annotation"),
    ]  # fmt: skip
    for table, field, target in references:
        dangling = {row[field] for row in tables[table]} - tokens[target] - {""}
        assert not dangling, (table, field)
    assert {t for row in tables["sample_annotation"] for t in row["attribute_tokens"]} <= tokens["attribute"]
    assert {t for row in tables["map"] for t in row["log_tokens"]} == tokens["log"]


def test_every_image_of_the_tables_exists_in_its_stated_size(root: Path, tables: Tables):
    assert len(tables["sample_data"]) == 2 * 3 * 6
    for row in tables["sample_data"]:
        assert cv2.imread(str(root / row["filename"])).shape == (row["height"], row["width"], 3)


def test_the_map_picture_is_white_where_cars_drive(root: Path, tables: Tables):
    picture = cv2.imread(str(root / tables["map"][0]["filename"]), cv2.IMREAD_GRAYSCALE)
    assert picture.shape == (2000, 2000)  # ten pixels a metre
    for pose in tables["ego_pose"]:
        x, y, _ = pose["translation"]
        assert picture[-int(y * 10) - 1, int(x * 10)] == 255


def test_cameras_fire_one_after_another_with_poses_of_their_own(tables: Tables):
    poses = {row["token"]: row for row in tables["ego_pose"]}
    first = [row for row in tables["sample_data"] if row["sample_token"] == tables["sample"][0]["token"]]
    times = [row["timestamp"] for row in first]
    assert len(set(times)) == 6
    assert 20_000 < max(times) - min(times) < 83_000  # microseconds; within one sweep of the lidar
    assert len({tuple(poses[row["ego_pose_token"]]["translation"]) for row in first}) == 6
    assert all(row["timestamp"] == poses[row["ego_pose_token"]]["timestamp"] for row in first)


def test_ego_poses_say_that_the_ground_is_flat(tables: Tables):
    assert {row["translation"][2] for row in tables["ego_pose"]} == {0.0}


def test_drives_of_one_route_see_the_same_street(tables: Tables):
    scene_of = {row["token"]: row["scene_token"] for row in tables["sample"]}
    place_of = {row["token"]: row["translation"][:2] for row in tables["ego_pose"]}
    places: dict[str, list] = {}
    for row in tables["sample_data"]:
        places.setdefault(scene_of[row["sample_token"]], []).append(place_of[row["ego_pose_token"]])
    first, second = (np.mean(track, axis=0) for track in places.values())
    assert np.linalg.norm(first - second) < 20


def test_static_depth_agrees_between_two_keyframes(root: Path, tables: Tables):
    front = [row for row in tables["sample_data"] if "/CAM_FRONT/" in row["filename"]][:2]
    (here, there), (truth, other) = (
        [camera_of(tables, row) for row in front], [truth_of(root, tables, row) for row in front],
    )  # fmt: skip
    depth_m = truth["depth"].astype(np.float64).ravel()
    static = (depth_m > 0) & (depth_m < 80) & (truth["instances"].ravel() < FIRST_ACTOR)
    pixels = pixel_centres(here.width_px, here.height_px)[static]
    origin, directions = here.rays(pixels)
    along_axis = directions @ here.world_from_camera[:3, 2]
    points = origin + directions * (depth_m[static] / along_axis)[:, None]
    seen, expected_m = there.project(points)
    inside = there.sees(points)
    columns, rows = np.floor(seen[inside]).astype(int).T
    found_m = other["depth"].astype(np.float64)[rows, columns]
    same = (found_m > 0) & (other["instances"][rows, columns] < FIRST_ACTOR)
    assert same.sum() > 500
    error = np.abs(found_m[same] - expected_m[inside][same]) / expected_m[inside][same]
    assert np.median(error) < 0.005


def test_boxes_sit_on_the_pixels_of_their_objects(root: Path, tables: Tables):
    checked = 0
    levels = {row["token"]: row["level"] for row in tables["visibility"]}
    for image in tables["sample_data"]:
        camera, truth = camera_of(tables, image), truth_of(root, tables, image)
        for box in tables["sample_annotation"]:
            if box["sample_token"] != image["sample_token"] or levels[box["visibility_token"]] != "v80-100":
                continue
            pixels, depth_m = camera.project([box["translation"]])
            if camera.sees([box["translation"]])[0] and depth_m[0] < 25 and box["size"][1] > 4:
                column, row = pixels[0].astype(int)
                checked += 1
                assert truth["instances"][row, column] >= FIRST_ACTOR
    assert checked > 0


def test_the_same_seed_writes_the_same_files(root: Path, tmp_path: Path):
    write_dataset(tmp_path, TINY, seed=5, threads=1)
    assert files_of(tmp_path) == files_of(root)


def test_an_interrupted_run_is_finished_by_running_it_again(root: Path, tmp_path: Path):
    class Interrupted(Exception):
        pass

    def stop_in_second_drive(progress: Progress) -> None:
        if progress.done == 4:
            raise Interrupted

    with pytest.raises(Interrupted):
        write_dataset(tmp_path, TINY, seed=5, report=stop_in_second_drive, threads=1)
    assert not (tmp_path / VERSION).exists()
    finished = {path: path.stat().st_mtime_ns for path in (tmp_path / "synth_gt" / "scene-0001").iterdir()}
    write_dataset(tmp_path, TINY, seed=5, threads=1)
    assert files_of(tmp_path) == files_of(root)
    assert {path: path.stat().st_mtime_ns for path in finished} == finished


def test_progress_counts_up_to_all_moments(root: Path):
    reports: list[Progress] = []
    write_dataset(root, TINY, seed=5, report=reports.append)
    assert reports[-1] == Progress("synth", 6, 6)
    assert [report.done for report in reports] == sorted(report.done for report in reports)


def test_a_folder_of_another_data_set_is_refused(root: Path):
    with pytest.raises(SettingsError, match=r"seed 5.*seed 6"):
        write_dataset(root, TINY, seed=6)


def test_an_unknown_preset_is_refused_before_anything_is_written(tmp_path: Path):
    with pytest.raises(SettingsError, match="choose one of"):
        write_dataset(tmp_path, "dmeo", seed=0)
    assert not any(tmp_path.iterdir())


def test_sweeps_fill_the_time_between_keyframes(tmp_path: Path):
    one_drive = 'towns.singapore-onenorth.train=["day"]'
    write_dataset(tmp_path, load_preset("ci", [*SMALL, "sweeps=true", one_drive, "keyframes=2"]), seed=5, threads=2)
    rows = json.loads((tmp_path / VERSION / "sample_data.json").read_text())
    samples = json.loads((tmp_path / VERSION / "sample.json").read_text())
    assert Counter(row["is_key_frame"] for row in rows) == {True: 12, False: 30}
    front = [row for row in rows if "/CAM_FRONT/" in row["filename"]]
    gaps = np.diff([row["timestamp"] for row in front])
    assert np.all(np.abs(gaps - 1e6 / 12) < 2)  # microseconds
    assert [row["sample_token"] for row in front] == [samples[0]["token"]] + 6 * [samples[1]["token"]]
    assert [row["next"] for row in front[:-1]] == [row["token"] for row in front[1:]]
    truths = list((tmp_path / "synth_gt").rglob("*.npz"))
    assert len(truths) == 12  # keyframes only
