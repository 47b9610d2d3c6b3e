"""Faults of single images: the frame is refused with code, file and cure; the rest of its drive goes on."""

import io
import math
import os

import numpy as np
import pytest
from PIL import Image

from presight_core.drives import Reject
from stages.ingest import IngestedDrive, ingest_nuscenes

VERSION = "v1.0-mini"
NAN = math.nan


def ingest_first(tiny) -> IngestedDrive:
    return next(iter(ingest_nuscenes(tiny.root, VERSION)))


def only_reject(tiny) -> Reject:
    """The one reject of the first drive; its other seven frames are there, and so is the second drive."""
    first, second = ingest_nuscenes(tiny.root, VERSION)
    assert (len(first.frames), len(second.frames), len(second.rejects)) == (7, 8, 0)
    (reject,) = first.rejects
    assert reject.drive == "scene-0000"
    assert reject.cure
    assert "\n" not in reject.file + reject.detail
    return reject


ROW_FAULTS = {
    # fault: (table, values of its first row, code, part of the detail)
    "NaN translation": ("ego_pose", {"translation": [NAN, 0.0, 0.0]}, "pose-invalid", "nan"),
    "infinite translation": ("ego_pose", {"translation": [0.0, math.inf, 0.0]}, "pose-invalid", "inf"),
    "absurd translation": ("ego_pose", {"translation": [0.0, 1e300, 0.0]}, "pose-invalid", "1e+300"),
    "NaN rotation": ("ego_pose", {"rotation": [NAN, 0.0, 0.0, 0.0]}, "pose-invalid", "nan"),
    "zero rotation": ("ego_pose", {"rotation": [0.0, 0.0, 0.0, 0.0]}, "pose-invalid", "[0.0, 0.0, 0.0, 0.0]"),
    "scaled rotation": ("ego_pose", {"rotation": [1.1, 0.0, 0.0, 0.0]}, "pose-invalid", "1.1"),
    "pose of another second": ("ego_pose", {"timestamp": 1_600_000_001_000_000}, "pose-time", "1.000 s"),
    "time in seconds": ("sample_data", {"timestamp": 1_600_000_000}, "time-invalid", "1600000000"),
    "time in nanoseconds": ("sample_data", {"timestamp": 1_600_000_000_000_000_000}, "time-invalid", "microseconds"),
    "climbing path": ("sample_data", {"filename": "../secret.jpg"}, "path-unsafe", "not a plain relative one"),
    "hidden climb": ("sample_data", {"filename": "samples/../../secret.jpg"}, "path-unsafe", "relative"),
    "absolute path": ("sample_data", {"filename": "/etc/passwd"}, "path-unsafe", "relative"),
    "folder for a file": ("sample_data", {"filename": "samples/CAM_FRONT/"}, "path-unsafe", "relative"),
    "line break in a path": ("sample_data", {"filename": "samples/a\nb.jpg"}, "path-unsafe", "relative"),
    "NUL in a path": ("sample_data", {"filename": "samples/a\0b.jpg"}, "path-unsafe", "relative"),
    "lone surrogate in a path": ("sample_data", {"filename": "samples/\ud800.jpg"}, "path-unsafe", "relative"),
    "missing image": ("sample_data", {"filename": "samples/CAM_FRONT/no.jpg"}, "image-missing", "no such file"),
    "missing folder": ("sample_data", {"filename": "samples/no/no.jpg"}, "image-missing", "no such file"),
    "wrong size": ("sample_data", {"width": 64}, "image-size", "32 x 24 pixels, the table says 64 x 24"),
}


@pytest.mark.parametrize("fault", ROW_FAULTS)
def test_a_faulty_row_costs_its_frame_only(tiny, fault):
    table, values, code, detail = ROW_FAULTS[fault]
    sound_path = tiny.images[0]["filename"]
    tiny.write()
    tiny.tables[table][0].update(values)
    spoilt_path = tiny.images[0]["filename"]
    tiny.write_tables()
    reject = only_reject(tiny)
    assert reject.code == code
    assert detail in reject.detail
    if code.startswith(("pose", "time")):
        assert reject.file == str(tiny.folder / f"{table}.json")
        assert sound_path in reject.detail
    elif spoilt_path.isprintable():
        assert reject.file == f"{tiny.root}/{spoilt_path}"


def saved(mode: str, kind: str, size: tuple[int, int] = (32, 24)) -> bytes:
    target = io.BytesIO()
    Image.new(mode, size).save(target, kind)
    return target.getvalue()


def sixteen_bits() -> bytes:
    target = io.BytesIO()
    Image.fromarray(np.zeros((24, 32), np.uint16)).save(target, "PNG")
    return target.getvalue()


IMAGE_FAULTS = {
    # fault: (content of the file from that of the sound one, code)
    "empty": (lambda jpeg: b"", "image-broken"),
    "cut short": (lambda jpeg: jpeg[:-100], "image-broken"),
    "cut in the header": (lambda jpeg: jpeg[:30], "image-broken"),
    "cut and filled with zeros": (lambda jpeg: jpeg[:-100] + bytes(100), "image-broken"),
    "text": (lambda jpeg: b"<html>404</html>", "image-broken"),
    "CMYK": (lambda jpeg: saved("CMYK", "JPEG"), "image-format"),
    "16 bits": (lambda jpeg: sixteen_bits(), "image-format"),
    "another size": (lambda jpeg: saved("RGB", "JPEG", (24, 32)), "image-size"),
    "PNG cut short": (lambda jpeg: saved("RGB", "PNG")[:-5], "image-broken"),
    "GIF": (lambda jpeg: saved("L", "GIF"), "image-broken"),
}


@pytest.mark.parametrize("fault", IMAGE_FAULTS)
def test_a_faulty_image_costs_its_frame_only(tiny, fault):
    content, code = IMAGE_FAULTS[fault]
    file = tiny.write() / tiny.images[0]["filename"]
    file.write_bytes(content(tiny.jpeg))
    reject = only_reject(tiny)
    assert (reject.code, reject.file) == (code, str(file))


@pytest.mark.parametrize("content", [saved("L", "JPEG"), saved("RGB", "PNG"), saved("RGB", "JPEG") + bytes(40)])
def test_grey_png_and_zero_padded_images_are_taken(tiny, content):
    (tiny.write() / tiny.images[0]["filename"]).write_bytes(content)
    assert ingest_first(tiny).rejects == ()


def test_a_link_out_of_the_root_is_refused(tiny, tmp_path):
    file = tiny.write() / tiny.images[0]["filename"]
    (tmp_path / "outside.jpg").write_bytes(tiny.jpeg)
    file.unlink()
    file.symlink_to(tmp_path / "outside.jpg")
    assert only_reject(tiny).code == "path-unsafe"


def test_a_folder_linked_out_of_the_root_is_refused(tiny, tmp_path):
    folder = tiny.write() / "samples" / "CAM_FRONT"
    folder.rename(tmp_path / "outside")
    folder.symlink_to(tmp_path / "outside")
    first = ingest_first(tiny)
    assert len(first.frames) == 6
    assert {reject.code for reject in first.rejects} == {"path-unsafe"}


def test_links_inside_the_root_and_to_the_root_are_followed(tiny, tmp_path):
    file = tiny.write() / tiny.images[0]["filename"]
    file.rename(tiny.root / "real.jpg")
    file.symlink_to(tiny.root / "real.jpg")
    (tmp_path / "linked").symlink_to(tiny.root)
    tiny.root = tmp_path / "linked"
    assert ingest_first(tiny).rejects == ()


def test_a_named_pipe_is_refused_without_waiting(tiny):
    file = tiny.write() / tiny.images[0]["filename"]
    file.unlink()
    os.mkfifo(file)
    assert only_reject(tiny).code == "image-unreadable"


INTRINSICS = {
    "zero focal length": [[0.0, 0.0, 16.0], [0.0, 20.0, 12.0], [0.0, 0.0, 1.0]],
    "negative focal length": [[20.0, 0.0, 16.0], [0.0, -20.0, 12.0], [0.0, 0.0, 1.0]],
    "NaN": [[20.0, 0.0, NAN], [0.0, 20.0, 12.0], [0.0, 0.0, 1.0]],
    "of a larger image": [[200.0, 0.0, 160.0], [0.0, 200.0, 120.0], [0.0, 0.0, 1.0]],
    "of two rows": [[20.0, 0.0, 16.0], [0.0, 20.0, 12.0]],
    "empty": [],
}


@pytest.mark.parametrize("fault", INTRINSICS)
def test_bad_intrinsics_cost_the_camera_not_the_drive(tiny, fault):
    tiny.tables["calibrated_sensor"][0]["camera_intrinsic"] = INTRINSICS[fault]
    tiny.write()
    first = ingest_first(tiny)
    assert set(first.frames.camera) == {"CAM_BACK"}
    assert {reject.code for reject in first.rejects} == {"intrinsics-invalid"}
    assert first.rejects[0].file == str(tiny.folder / "calibrated_sensor.json")


def test_a_camera_mounted_nowhere_is_refused(tiny):
    tiny.tables["calibrated_sensor"][0]["rotation"] = [0.0, 0.0, 0.0, 0.0]
    tiny.write()
    assert {reject.code for reject in ingest_first(tiny).rejects} == {"calibration-invalid"}


def test_two_images_of_a_camera_at_one_time_are_both_refused(tiny):
    tiny.images[2]["timestamp"] = tiny.images[0]["timestamp"]
    tiny.tables["ego_pose"][3]["timestamp"] = tiny.images[0]["timestamp"]
    tiny.write()
    first = ingest_first(tiny)
    assert [reject.code for reject in first.rejects] == ["time-twice", "time-twice"]
    assert len(first.frames) == 6


def test_a_drive_without_good_frames_is_empty_and_says_why(tiny):
    tiny.write()
    for row in tiny.images[:8]:
        (tiny.root / row["filename"]).unlink()
    first, second = ingest_nuscenes(tiny.root, VERSION)
    assert (first.drive.frame_count, len(first.frames), len(first.rejects)) == (0, 0, 8)
    assert first.drive.drive_id != second.drive.drive_id


def test_a_scene_without_images_says_so(tiny):
    tiny.tables["sample_data"] = [row for row in tiny.tables["sample_data"] if row["sample_token"] > "sample-1"]
    tiny.write()
    (reject,) = ingest_first(tiny).rejects
    assert reject.code == "drive-empty"


def test_many_rejects_of_a_kind_are_counted_not_listed(tiny, monkeypatch):
    monkeypatch.setattr("stages.ingest.LISTED_REJECTS", 3)
    tiny.write()
    for row in tiny.images[:8]:
        (tiny.root / row["filename"]).unlink()
    rejects = ingest_first(tiny).rejects
    assert len(rejects) == 4
    assert rejects[-1].detail.endswith("(and 4 more frames like it)")
