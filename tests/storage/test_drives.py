"""The drive index gives back what was put in, and never half a file."""

from dataclasses import fields, replace

import numpy as np
import pytest

from presight_core.drives import Drive, FrameTable, Reject
from presight_core.errors import NotFoundError, StoreError
from storage import drives
from storage.drives import DriveIndex

DRIVE = Drive("0123456789abcdef", "scene-0001", "toytown", "/data", "v1.0-mini", "2020-09-13", 3, 1, 3)
REJECT = Reject("image-missing", "/data/a.jpg", "no such file", "extract it", "scene-0001")


def frames(count: int = 3) -> FrameTable:
    randomness = np.random.default_rng(0)
    return FrameTable(
        drive_id=np.full(count, DRIVE.drive_id),
        camera=np.array(["CAM_BACK", "CAM_FRONT", "CAM_FRONT"])[:count],
        timestamp_us=np.arange(count) + 2**53 + 1,  # a float64 would lose these
        path=np.array(["samples/a.jpg", "samples/ü.jpg", "b.jpg"])[:count],
        file_bytes=np.arange(count),
        width_px=np.full(count, 32, np.int32),
        height_px=np.full(count, 24, np.int32),
        intrinsics=randomness.normal(size=(count, 3, 3)),
        world_from_camera=randomness.normal(size=(count, 4, 4)),
        is_keyframe=np.array([True, False, True])[:count],
    )


def assert_equal(first: FrameTable, second: FrameTable) -> None:
    for column in fields(FrameTable):
        one, other = getattr(first, column.name), getattr(second, column.name)
        np.testing.assert_array_equal(one, other)
        assert one.dtype.kind == other.dtype.kind
        assert one.dtype.itemsize == other.dtype.itemsize or one.dtype.kind == "U"


@pytest.fixture
def index(tmp_path) -> DriveIndex:
    return DriveIndex(tmp_path / "drives")


@pytest.mark.parametrize("count", [3, 0])
def test_frames_come_back_bit_for_bit(index, count):
    index.add(DRIVE, frames(count), [REJECT])
    assert_equal(index.frames(DRIVE.drive_id), frames(count))
    assert index.rejects(DRIVE.drive_id) == (REJECT,)


def test_frames_may_be_written_to(index):
    index.add(DRIVE, frames())
    assert all(getattr(index.frames(DRIVE.drive_id), column.name).flags.writeable for column in fields(FrameTable))


def test_drives_are_listed_by_id(index):
    other = replace(DRIVE, drive_id="0000000000000000")
    index.add(DRIVE, frames())
    index.add(other, frames())
    assert index.drives() == [other, DRIVE]


def test_an_index_without_drives_is_empty(index):
    assert index.drives() == []


def test_adding_the_same_drive_again_leaves_its_file_alone(index):
    index.add(DRIVE, frames(), [REJECT])
    (file,) = index.folder.iterdir()
    before = file.stat().st_ino
    index.add(DRIVE, frames(), [REJECT])
    assert file.stat().st_ino == before


def test_a_drive_that_moved_is_written_anew(index):
    index.add(DRIVE, frames())
    index.add(replace(DRIVE, root="/elsewhere"), frames())
    assert index.drive(DRIVE.drive_id).root == "/elsewhere"


def test_a_crash_before_the_rename_leaves_the_old_file(index, monkeypatch):
    index.add(DRIVE, frames())

    def crash(*_, **__):
        raise OSError("No space left on device")

    monkeypatch.setattr(drives.parquet, "write_table", crash)
    with pytest.raises(StoreError, match="No space left"):
        index.add(replace(DRIVE, root="/elsewhere"), frames())
    assert index.drives() == [DRIVE]
    assert len(list(index.folder.iterdir())) == 1


def test_an_unknown_drive_is_told_how_to_come_in(index):
    with pytest.raises(NotFoundError, match="presight ingest"):
        index.frames("ffffffffffffffff")


def test_a_drive_id_cannot_climb_out_of_the_folder(index):
    with pytest.raises(NotFoundError, match="not a drive id"):
        index.frames("../catalog")


@pytest.mark.parametrize("kept", [0, 100, -4])
def test_a_damaged_file_is_named_and_can_be_replaced(index, kept):
    index.add(DRIVE, frames())
    (file,) = index.folder.iterdir()
    file.write_bytes(file.read_bytes()[:kept])
    with pytest.raises(StoreError, match=f"{file}: damaged .*; delete it and ingest"):
        index.frames(DRIVE.drive_id)
    index.add(DRIVE, frames())
    assert_equal(index.frames(DRIVE.drive_id), frames())


def test_a_removed_drive_is_gone(index):
    index.add(DRIVE, frames())
    index.remove(DRIVE.drive_id)
    index.remove(DRIVE.drive_id)
    assert index.drives() == []
