"""Synthetic data sets: complete tables, true poses, resumable and reproducible files."""

import itertools
import json
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest

from presight_core.cameras import Camera, pixel_centres
from presight_core.classes import CITYSCAPES
from presight_core.errors import SettingsError
from presight_core.frames import rotation_from_quaternion, transform
from presight_core.nuscenes_split import TEST_SCENES
from presight_core.progress import Progress
from presight_core.synthetic import load_preset, write_dataset
from presight_core.synthetic.actors import FIRST_ACTOR
from presight_core.synthetic.city import City
from presight_core.synthetic.drive_plan import plan_drive, plan_streets
from presight_core.synthetic.nuscenes import TABLES
from presight_core.synthetic.surface_points import read_surface_points

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


def test_static_depth_agrees_between_keyframes(root: Path, tables: Tables):
    images: dict[tuple[str, str], list[dict]] = {}
    scene_of = {row["token"]: row["scene_token"] for row in tables["sample"]}
    for row in tables["sample_data"]:
        images.setdefault((scene_of[row["sample_token"]], row["filename"].split("/")[1]), []).append(row)
    pairs = [pair for rows in images.values() for pair in itertools.pairwise(rows)]
    errors = np.concatenate([depth_errors(root, tables, *pair) for pair in pairs])
    assert len(errors) > 20_000
    assert np.median(errors) < 0.005


def depth_errors(root: Path, tables: Tables, first: dict, second: dict) -> np.ndarray:
    """Relative differences between the depth of one image, seen from another, and the other's own."""
    here, there = camera_of(tables, first), camera_of(tables, second)
    truth, other = truth_of(root, tables, first), truth_of(root, tables, second)
    depth_m = truth["depth"].astype(np.float64).ravel()
    static = (depth_m > 0) & (depth_m < 80) & (truth["instances"].ravel() < FIRST_ACTOR)
    origin, directions = here.rays(pixel_centres(here.width_px, here.height_px)[static])
    along_axis = directions @ here.world_from_camera[:3, 2]
    points = origin + directions * (depth_m[static] / along_axis)[:, None]
    points = points[there.sees(points)]
    pixels, expected_m = there.project(points)
    columns, rows = np.floor(pixels).astype(int).T
    is_static = (other["depth"][rows, columns] > 0) & (other["instances"][rows, columns] < FIRST_ACTOR)
    if not is_static.any():  # cars, or another part of the street
        return np.zeros(0)
    # On a plane the inverse of the depth is linear in the image: interpolation is then exact.
    nearness = 1 / np.maximum(other["depth"].astype(np.float32), 1e-3)
    x, y = (pixels[is_static] - 0.5).astype(np.float32).T
    found_m = 1 / cv2.remap(nearness, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel()
    return np.abs(found_m - expected_m[is_static]) / expected_m[is_static]


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
    kept = [*(tmp_path / "synth_gt" / "scene-0001").iterdir(), *tmp_path.glob("samples/CAM_FRONT/*.jpg")]
    finished = {path: path.stat().st_mtime_ns for path in kept}
    write_dataset(tmp_path, TINY, seed=5, threads=1)
    assert files_of(tmp_path) == files_of(root)
    assert {path: path.stat().st_mtime_ns for path in finished} == finished


def test_progress_counts_up_to_all_moments(root: Path):
    reports: list[Progress] = []
    write_dataset(root, TINY, seed=5, report=reports.append)
    assert reports[-1] == Progress("synth", 6, 6)
    assert [report.done for report in reports] == sorted(report.done for report in reports)


def test_a_folder_of_another_data_set_is_refused(root: Path):
    with pytest.raises(SettingsError, match=r": seed is 5, wanted 6; choose another folder"):
        write_dataset(root, TINY, seed=6)
    with pytest.raises(SettingsError, match=r": preset.lidar is False, wanted True; choose"):
        write_dataset(root, TINY.model_copy(update={"lidar": True}), seed=5)


def test_an_unknown_preset_is_refused_before_anything_is_written(tmp_path: Path):
    with pytest.raises(SettingsError, match="choose one of"):
        write_dataset(tmp_path, "dmeo", seed=0)
    assert not any(tmp_path.iterdir())


def test_sweeps_fill_the_time_between_keyframes(tmp_path: Path):
    one_drive = 'towns.singapore-onenorth.train=["day"]'
    preset = load_preset("ci", [*SMALL, "sweeps=true", "lidar=true", one_drive, "keyframes=2"])
    write_dataset(tmp_path, preset, seed=5, threads=2)
    rows = json.loads((tmp_path / VERSION / "sample_data.json").read_text())
    samples = json.loads((tmp_path / VERSION / "sample.json").read_text())
    assert Counter(row["is_key_frame"] for row in rows) == {True: 14, False: 39}  # 12 and 30 images, 2 and 9 turns
    turns = [row["timestamp"] for row in rows if "/LIDAR_TOP/" in row["filename"]]
    assert set(np.diff(turns)) == {50_000}  # microseconds
    front = [row for row in rows if "/CAM_FRONT/" in row["filename"]]
    gaps = np.diff([row["timestamp"] for row in front])
    assert np.all(np.abs(gaps - 1e6 / 12) < 2)  # microseconds
    assert [row["sample_token"] for row in front] == [samples[0]["token"]] + 6 * [samples[1]["token"]]
    assert [row["next"] for row in front[:-1]] == [row["token"] for row in front[1:]]
    truths = list((tmp_path / "synth_gt").rglob("*.npz"))
    assert len(truths) == 12  # keyframes only


# ---- all that a data set can hold --------------------------------------------------------------------------------

FULL = load_preset(
    "ci",
    [
        *SMALL, "keyframes=2", "lidar=true", "occupancy=true", "surface=true", "paper_split=true",
        'towns.singapore-onenorth.train=[]', 'towns.singapore-onenorth.test=["night"]',
        'towns.boston-seaport={train=["day"], style={size_m=200.0, spacing_m=90.0, left_hand=false}}',
    ],
)  # fmt: skip


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("full")
    write_dataset(folder, FULL, seed=1, threads=2)
    return folder


def rows_of(root: Path, table: str) -> list[dict]:
    return json.loads((root / FULL.version / f"{table}.json").read_text())


def test_each_city_has_its_own_logs_and_maps(full: Path):
    logs = {row["token"]: row["location"] for row in rows_of(full, "log")}
    assert sorted(logs.values()) == ["boston-seaport", "singapore-onenorth"]
    for row in rows_of(full, "map"):
        assert len({logs[token] for token in row["log_tokens"]}) == 1
        assert (full / row["filename"]).is_file()
    for location in logs.values():
        assert (full / "maps" / "expansion" / f"{location}.json").is_file()


def test_scene_names_follow_the_papers_split(full: Path):
    names = {row["name"] for row in rows_of(full, "scene")}
    assert len(names) == 2
    assert len(names & set(TEST_SCENES)) == 1


def test_lidar_points_lie_on_the_boxes_that_count_them(full: Path):
    calibration = next(r for r in rows_of(full, "calibrated_sensor") if r["camera_intrinsic"] == [])
    ego_from_lidar = transform(rotation_from_quaternion(calibration["rotation"]), calibration["translation"])
    poses = {row["token"]: row for row in rows_of(full, "ego_pose")}
    checked = 0
    for file in (row for row in rows_of(full, "sample_data") if row["fileformat"] == "pcd"):
        points = np.fromfile(full / file["filename"], np.float32).reshape(-1, 5)[:, :3].astype(np.float64)
        pose = poses[file["ego_pose_token"]]
        world_from_lidar = transform(rotation_from_quaternion(pose["rotation"]), pose["translation"]) @ ego_from_lidar
        world = points @ world_from_lidar[:3, :3].T + world_from_lidar[:3, 3]
        for box in rows_of(full, "sample_annotation"):
            if box["sample_token"] == file["sample_token"] and box["num_lidar_pts"] > 20:
                world_from_box = transform(rotation_from_quaternion(box["rotation"]), box["translation"])
                local = (world - world_from_box[:3, 3]) @ world_from_box[:3, :3]
                half = np.array(box["size"])[[1, 0, 2]] / 2 + 0.1  # a hand's breadth: the lidar's noise
                inside = int((np.abs(local) < half).all(1).sum())
                assert inside >= 0.9 * box["num_lidar_pts"]
                checked += 1
    assert checked > 3


def test_occupancy_lies_where_occ3d_has_it_and_covers_the_road_under_the_car(full: Path):
    scenes = {row["token"]: row["name"] for row in rows_of(full, "scene")}
    for sample in rows_of(full, "sample"):
        with np.load(full / "gts" / scenes[sample["scene_token"]] / sample["token"] / "labels.npz") as labels:
            assert sorted(labels) == ["mask_camera", "mask_lidar", "semantics"]
            under = labels["semantics"][95:105, 95:105, 1:4]  # 4 m around the car, -0.6 to 0.6 m
            assert (under == 11).any(axis=2).mean() > 0.9  # 11: driveable_surface


def test_surface_points_cover_the_streets(full: Path):
    points, labels = read_surface_points(full / "synth_gt" / "surface" / "boston-seaport.npz")
    assert points.shape == (len(labels), 3)
    assert (labels == CITYSCAPES.index("road")).sum() > 10_000
    assert points[labels == CITYSCAPES.index("road"), 2].max() < 0.5


def test_the_contact_sheet_is_drawn(full: Path):
    assert cv2.imread(str(full / "contact_sheet.png")).std() > 30


@pytest.mark.parametrize("true_height", [False, True])
def test_recorded_poses_tilt_with_the_ground_and_tell_its_height_only_if_asked(true_height: bool):
    preset = load_preset(
        "ci", [f"true_height={str(true_height).lower()}", "towns.singapore-onenorth.style.relief_m=0.5"]
    )
    town = preset.towns["singapore-onenorth"]
    city = City(4, town.style)
    plan = plan_drive(city, preset, plan_streets(city, town, preset.keyframes), preset.drives[0])
    true, recorded = plan.world_from_ego(1.0), plan.recorded_pose(1.0)
    np.testing.assert_array_equal(recorded[:3, :3], true[:3, :3])
    assert abs(true[2, 3]) > 0.01
    assert recorded[2, 3] == (true[2, 3] if true_height else 0.0)
    assert 1e-4 < np.hypot(*true[:2, 2]) < 0.02  # the car's up axis leans
