"""Positions of a city's drives are those of the index, whatever the file beside it holds."""

from dataclasses import replace

import numpy as np
import pytest

from presight_core.drives import FrameTable
from presight_core.errors import NotFoundError
from storage.drive_positions import read_positions
from storage.drives import DriveIndex
from tests.storage.test_drives import DRIVE, frames


@pytest.fixture
def index(tmp_path) -> DriveIndex:
    index = DriveIndex(tmp_path)
    for number in range(4):
        table = frames(count=number % 3 + 1)
        moved = table.world_from_camera + number
        drive_id = f"{number:016x}"
        table = replace(table, drive_id=np.full(len(table), drive_id), world_from_camera=moved)
        index.add(replace(DRIVE, drive_id=drive_id, frame_count=len(table)), table)
    return index


def ids(index: DriveIndex) -> list[str]:
    return [drive.drive_id for drive in index.drives()]


def require_same(index: DriveIndex, drive_ids: list[str]) -> None:
    found = read_positions(index, "town", drive_ids)
    assert found.drive_ids == tuple(drive_ids)
    truth = FrameTable.concatenate([index.frames(drive_id) for drive_id in drive_ids])
    np.testing.assert_array_equal(found.positions, truth.positions)
    np.testing.assert_array_equal(found.is_keyframe, truth.is_keyframe)
    np.testing.assert_array_equal(np.array(drive_ids)[found.drive], truth.drive_id)


def test_positions_are_those_of_the_index_however_drives_come_and_go(index):
    first, second, third, fourth = ids(index)
    for wanted in ([first], [second, first], [first, second, third], [fourth, second], [first, second, third, fourth]):
        require_same(index, wanted)


def test_a_drive_that_is_known_is_not_read_again(index, monkeypatch):
    drive_ids = ids(index)
    read_positions(index, "town", drive_ids)
    monkeypatch.setattr(DriveIndex, "positions", lambda *_: pytest.fail("read again"))
    assert read_positions(index, "town", drive_ids).drive_ids == tuple(drive_ids)


def test_a_damaged_file_is_made_again(index):
    drive_ids = ids(index)
    read_positions(index, "town", drive_ids)
    file = index.folder / "positions/town.parquet"
    for content in (b"", file.read_bytes()[:-9], b"no parquet at all"):
        file.write_bytes(content)
        require_same(index, drive_ids)


def test_a_drive_that_is_nowhere_is_named(index):
    with pytest.raises(NotFoundError, match="no drive 00ff"):
        read_positions(index, "town", [*ids(index), "00ff"])
