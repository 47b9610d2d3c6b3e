"""Good data: every image becomes a frame, with its own pose; the drive's name is its content."""

import json
import random
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from presight_core import frames
from presight_core.classes import CITYSCAPES, SKY
from presight_core.drives import FrameTable
from presight_core.errors import InputError
from presight_core.progress import Progress
from stages.ingest import ingest_nuscenes
from stages.scene_choice import SceneChoice

VERSION = "v1.0-mini"
GROUND = [CITYSCAPES.index(name) for name in ("road", "sidewalk", "terrain")]


def ingest(root: Path):
    return list(ingest_nuscenes(root, VERSION))


def test_every_scene_becomes_a_drive_and_every_camera_image_a_frame(tiny):
    first, second = ingest(tiny.write())
    assert (first.drive.name, second.drive.name) == ("scene-0000", "scene-0001")
    assert (first.drive.city, first.drive.captured, first.drive.version) == ("toytown", "2020-09-13", VERSION)
    assert len(first.frames) == first.drive.frame_count == 8  # two cameras, two keyframes, two sweeps
    assert first.rejects == ()
    assert first.frames.is_keyframe.sum() == 4


def test_scenes_can_be_chosen_by_name_by_the_papers_split_and_by_the_dark(tiny):
    tiny.tables["scene"][0] |= {"name": "scene-0001", "description": "Night, parked cars"}  # a test scene
    tiny.tables["scene"][1] |= {"name": "scene-0002"}
    root = tiny.write()

    def names(**choice) -> list[str]:
        return [each.drive.name for each in ingest_nuscenes(root, VERSION, choice=SceneChoice(**choice))]

    assert names() == ["scene-0001", "scene-0002"]
    assert names(names=("scene-00*1", "other")) == ["scene-0001"]
    assert names(tests=False) == ["scene-0002"]
    assert names(nights=False) == ["scene-0002"]


def test_a_choice_of_no_scene_is_refused_with_what_there_is(tiny):
    with pytest.raises(InputError, match=r"no scene named scene-1.*, not at night; its 2 scenes are scene-0000 to"):
        ingest_nuscenes(tiny.write(), VERSION, choice=SceneChoice(names=("scene-1*",), nights=False))


def test_frames_are_ordered_by_camera_then_time(tiny):
    table = ingest(tiny.write())[0].frames
    keys = list(zip(table.camera.tolist(), table.timestamp_us.tolist(), strict=True))
    assert keys == sorted(keys)


def test_a_frame_takes_the_ego_pose_of_its_own_time_not_of_its_keyframe(tiny):
    table = ingest(tiny.write())[0].frames
    seconds = (table.timestamp_us - table.timestamp_us.min()) / 1e6
    np.testing.assert_allclose(table.positions[:, 0], 1 + 10 * seconds, atol=1e-9)


def test_world_from_camera_joins_ego_pose_and_calibration(tiny):
    first = ingest(tiny.write())[0].frames
    forward_world = first.world_from_camera[0, :3, 2]
    np.testing.assert_allclose(forward_world, [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(first.positions[0], [1, 5, 1.5], atol=1e-12)


def test_a_frame_knows_the_size_of_its_file_and_image(tiny):
    table = ingest(tiny.write())[0].frames
    assert set(table.file_bytes) == {len(tiny.jpeg)}
    assert (table.width_px[0], table.height_px[0]) == (32, 24)


def test_a_drive_is_named_by_its_content_not_by_the_order_of_rows(tiny):
    before = [ingested.drive.drive_id for ingested in ingest(tiny.write())]
    for rows in tiny.tables.values():
        random.Random(0).shuffle(rows)
    assert sorted(ingested.drive.drive_id for ingested in ingest(tiny.write())) == sorted(before)


def test_a_drive_is_the_same_under_another_scene_name_and_root(tiny, tmp_path):
    before = ingest(tiny.write())[0].drive.drive_id
    tiny.tables["scene"][0]["name"] = "scene-renamed"
    tiny.root = tmp_path / "elsewhere"
    assert ingest(tiny.write())[0].drive.drive_id == before


SPOILERS = {
    "pose": lambda tables: tables["ego_pose"][0].update(translation=[0.0, 5.001, 0.0]),
    "rotation": lambda tables: tables["ego_pose"][0].update(rotation=[0.0, 1.0, 0.0, 0.0]),
    "intrinsics": lambda tables: tables["calibrated_sensor"][0]["camera_intrinsic"][0].__setitem__(0, 20.5),
    "time": lambda tables: tables["sample_data"][0].update(timestamp=tables["sample_data"][0]["timestamp"] + 1),
    "keyframe": lambda tables: tables["sample_data"][0].update(is_key_frame=False),
    "path": lambda tables: tables["sample_data"][0].update(filename="samples/CAM_FRONT/other.jpg"),
    "city": lambda tables: tables["log"][0].update(location="othertown"),
}


@pytest.mark.parametrize("change", SPOILERS)
def test_a_drive_with_any_other_content_has_another_name(tiny, change):
    before = ingest(tiny.write())[0].drive.drive_id
    SPOILERS[change](tiny.tables)
    assert ingest(tiny.write())[0].drive.drive_id != before


def test_optional_tables_and_unknown_fields_are_passed_over(tiny):
    tiny.tables["sample_data"][0]["colour"] = {"nested": ["},", {"{": "},{"}]}
    root = tiny.write()
    (tiny.folder / "sample_annotation.json").write_text("not JSON")
    assert len(ingest(root)) == 2


def test_several_images_may_share_an_ego_pose(tiny):
    shared = tiny.images[0]["ego_pose_token"]
    tiny.images[1]["ego_pose_token"] = shared
    assert ingest(tiny.write())[0].drive.frame_count == 8


def test_images_are_left_alone_when_trusted(tiny):
    root = tiny.write()
    for row in tiny.images:
        (root / row["filename"]).unlink()
    first = next(iter(ingest_nuscenes(root, VERSION, images="trust")))
    assert len(first.frames) == 8
    assert set(first.frames.file_bytes) == {0}


def test_progress_ends_at_the_total_of_every_part(tiny):
    seen: dict[str, Progress] = {}
    list(ingest_nuscenes(tiny.write(), VERSION, lambda progress: seen.__setitem__(progress.stage, progress)))
    assert set(seen) == {"read sample_data", "read ego_pose", "ingest"}
    assert all(progress.done == progress.total for progress in seen.values())
    assert seen["ingest"].figures == {"frames": 16.0, "rejected": 0.0}


@pytest.mark.parametrize(("name", "frame_count"), [("kitti-street", 51), ("herz-jesu", 25), ("nuscenes-keyframe", 6)])
def test_the_real_data_sets_are_ingested_whole(shared_data, name, frame_count):
    (ingested,) = ingest(shared_data / name)
    assert (ingested.drive.frame_count, ingested.rejects) == (frame_count, ())


@pytest.fixture(scope="module")
def keyframe(shared_data) -> Path:
    return shared_data / "nuscenes-keyframe"


@pytest.fixture(scope="module")
def table(keyframe) -> FrameTable:
    (ingested,) = ingest_nuscenes(keyframe, VERSION)
    return ingested.frames


@pytest.fixture(scope="module")
def points_world(keyframe) -> np.ndarray:
    """The lidar sweep in world metres, by the lidar's own pose; the vehicle itself left out."""
    tables = {
        name: {row["token"]: row for row in json.loads((keyframe / VERSION / f"{name}.json").read_text())}
        for name in ("sample_data", "ego_pose", "calibrated_sensor")
    }
    lidar = next(row for row in tables["sample_data"].values() if "LIDAR_TOP" in row["filename"])
    points = np.fromfile(keyframe / lidar["filename"], np.float32).reshape(-1, 5)[:, :3].astype(np.float64)
    points = points[np.linalg.norm(points, axis=-1) > 3]  # metres; nearer returns are the vehicle's own roof
    for target in ("calibrated_sensor", "ego_pose"):
        row = tables[target][lidar[f"{target}_token"]]
        rotation = frames.rotation_from_quaternion(row["rotation"])
        points = frames.apply(frames.transform(rotation, row["translation"]), points)
    return points


def contradictions(keyframe: Path, table: FrameTable, row: int, points_world: np.ndarray) -> float:
    """Share of the lidar points in an image that fall on the wrong label.

    Wrong is: any point on sky, a point more than 1 m high on the ground, and one below 0.15 m off the ground.
    """
    camera = table.camera_of(row)
    labels = np.asarray(Image.open(keyframe / "segmentation" / Path(table.path[row]).with_suffix(".png")))
    seen = points_world[camera.sees(points_world)]
    pixels, _ = camera.project(seen)
    x, y = (pixels * [labels.shape[1] / camera.width_px, labels.shape[0] / camera.height_px]).astype(int).T
    label, height_m = labels[y, x], seen[:, 2]  # the street is flat there, and the world's zero
    on_ground = np.isin(label, GROUND)
    wrong = (label == SKY) | (on_ground & (height_m > 1.0)) | (~on_ground & (height_m < 0.15))
    return float(wrong.mean())


def turned(table: FrameTable, yaw_deg: float = 0, pitch_deg: float = 0) -> FrameTable:
    """The same frames with every camera turned on its place."""
    world_from_camera = table.world_from_camera.copy()
    yaw = frames.planar_transform(0, 0, np.radians(yaw_deg))[:3, :3]
    c, s = np.cos(np.radians(pitch_deg)), np.sin(np.radians(pitch_deg))
    world_from_camera[:, :3, :3] = yaw @ world_from_camera[:, :3, :3] @ [[1, 0, 0], [0, c, -s], [0, s, c]]
    return replace(table, world_from_camera=world_from_camera)


def test_six_cameras_see_the_same_lidar_points_where_their_pictures_show_them(keyframe, table, points_world):
    assert len(set(table.camera)) == 6
    for row in range(6):
        assert table.camera_of(row).sees(points_world).sum() > 1000
        assert contradictions(keyframe, table, row, points_world) < 0.03


def test_a_camera_tilted_by_five_degrees_contradicts_its_picture(keyframe, table, points_world):
    tilted = turned(table, pitch_deg=-5)
    for row in range(6):
        right = contradictions(keyframe, table, row, points_world)
        assert contradictions(keyframe, tilted, row, points_world) > 4 * right


@pytest.mark.parametrize("yaw_deg", [-20, 20])
def test_a_vehicle_turned_by_twenty_degrees_contradicts_its_pictures(keyframe, table, points_world, yaw_deg):
    def mean(frames_of_rig: FrameTable) -> float:
        return float(np.mean([contradictions(keyframe, frames_of_rig, row, points_world) for row in range(6)]))

    assert mean(turned(table, yaw_deg=yaw_deg)) > 3 * mean(table)
