"""A drive that is removed, or is there to test, is in no generation that comes after."""

import numpy as np
import pytest

from flows.drives import find_drive, remove_drive
from flows.plan import plan_city
from flows.publication import roll_back
from flows.reconcile import hold_city
from presight_core.config import load_city_settings
from presight_core.errors import InputError, NotFoundError
from presight_core.priors.reader import PriorReader
from storage.leases import LeaseHeldError
from storage.restoration import restore
from storage.workspace import Workspace
from tests.torture.toy_city import CITY, SETTINGS, ToyCity

SPLIT = '[split]\ntrain = ["scene-0000"]\ntest = ["scene-0001"]\n'


def plan_of(city: ToyCity):
    return plan_city(city.workspace, CITY, load_city_settings(city.workspace.city_file(CITY)))


def drive_id(city: ToyCity, name: str) -> str:
    return find_drive([record.drive for record in city.workspace.catalog().drive_records()], name).drive_id


def set_split(city: ToyCity, text: str) -> None:
    city.workspace.city_file(CITY).write_text(SETTINGS + text)


def shown_drives(city: ToyCity) -> tuple[set[str], dict[str, str]]:
    """Drives with a bit in a voxel of the newest generation, and the drives that it names."""
    reader = PriorReader.open(city.root / "store", CITY)
    seen: set[str] = set()
    for tile_id, tile in reader.generation.tiles.items():
        bits = np.bitwise_or.reduce(reader.tile(tile_id).all_rows("drives"), axis=0)
        seen |= {drive for number, drive in enumerate(tile.entry.drives) if bits[number // 32] >> number % 32 & 1}
    return seen, reader.drive_names


def test_a_removed_drive_is_gone_from_bits_and_names_of_the_next_generation(city):
    removed = drive_id(city, "scene-0001")
    assert removed in shown_drives(city)[0]
    remove_drive(city.workspace, "scene-0001")
    assert [tile.tile_id for tile in plan_of(city).stale] == ["t000", "t001"]
    assert city.build() == 2
    kept = drive_id(city, "scene-0000")
    assert shown_drives(city) == ({kept}, {kept: "scene-0000"})


def test_a_rollback_does_not_bring_a_removed_drive_back(city):
    assert roll_back(city.root, CITY, 1) == 2
    remove_drive(city.workspace, "scene-0001")
    with pytest.raises(InputError, match="generation 1 may not be shown again: drive scene-0001 was removed"):
        roll_back(city.root, CITY, 1)


def test_a_tile_that_cannot_be_built_without_a_removed_drive_is_withdrawn(city):
    for name in ("scene-0000", "scene-0001"):
        remove_drive(city.workspace, name)
    plan = plan_of(city)
    assert plan.stale == ()
    assert plan.withdrawn["t000"] == "drive scene-0000 was removed; drive scene-0001 was removed"
    assert city.build() == 2
    assert shown_drives(city) == (set(), {})
    assert plan_of(city).is_current
    assert {build.state for build in city.workspace.catalog().builds(CITY)} == {"withdrawn"}


def test_a_drive_is_not_removed_under_a_running_build(city):
    with hold_city(city.workspace, CITY), pytest.raises(LeaseHeldError):
        remove_drive(city.workspace, "scene-0001")
    assert len(city.workspace.catalog().drives(CITY)) == 2


def test_a_removed_drive_does_not_come_back_with_a_new_catalog(city):
    remove_drive(city.workspace, "scene-0001")
    removed_at = city.workspace.catalog().drive_records(CITY)[1].removed_at
    for file in city.root.glob("catalog.sqlite*"):
        file.unlink()
    workspace = city.workspace
    restore(workspace.catalog(), workspace.drives(), workspace.store())
    assert [record.removed_at for record in workspace.catalog().drive_records(CITY)] == [None, removed_at]


def test_a_removed_drive_whose_index_was_cleared_is_removed_all_the_same(city):
    city.workspace.drives().remove(drive_id(city, "scene-0001"))
    remove_drive(city.workspace, "scene-0001")
    assert [drive.name for drive in city.workspace.catalog().drives(CITY)] == ["scene-0000"]


def test_a_drive_that_is_declared_a_test_leaves_the_prior(city):
    set_split(city, SPLIT + "allow_overlap = true\n")
    assert city.build() == 2
    kept = drive_id(city, "scene-0000")
    assert shown_drives(city) == ({kept}, {kept: "scene-0000"})


def test_a_drive_outside_build_from_leaves_the_prior_too(city):
    set_split(city, '[split]\ntrain = ["scene-0000"]\nprior = ["scene-0001"]\nbuild_from = ["prior"]\n')
    assert city.build() == 2
    assert set(shown_drives(city)[1].values()) == {"scene-0001"}


def test_train_and_test_drives_on_the_same_ground_are_refused(city):
    set_split(city, SPLIT + "overlap_m = 1000.0\n")
    with pytest.raises(InputError, match="100% of the test ground"):
        plan_of(city)


def test_a_city_of_test_drives_alone_has_no_prior(tmp_path):
    made = ToyCity(tmp_path / "workspace", tmp_path / "data")
    made.prepare()
    made.ingest()
    set_split(made, '[split]\ntest = ["scene-*"]\n')
    with pytest.raises(InputError, match="none of its 2 drives makes a prior"):
        plan_of(made)


def test_a_name_that_is_no_drive_or_two_is_refused(city):
    drives = Workspace.catalog(city.workspace).drives()
    with pytest.raises(NotFoundError, match="drives list"):
        find_drive(drives, "scene-0009")
    with pytest.raises(InputError, match="2 drives have this name"):
        find_drive([drives[0], drives[0]], drives[0].name)


def test_the_commands_list_and_remove(city, presight):
    listed = presight(city.root, "drives", "list")
    assert "scene-0001" in listed.stdout
    removed = presight(city.root, "drives", "remove", "scene-0001")
    assert (removed.returncode, "t000, t001" in removed.stdout) == (0, True)
