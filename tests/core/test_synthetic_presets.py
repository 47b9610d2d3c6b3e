"""Presets of synthetic data sets: settings from the command line, and which drives they order."""

import pytest

from presight_core.errors import SettingsError
from presight_core.nuscenes_split import PRIOR_SCENES, TEST_SCENES
from presight_core.synthetic.presets import PRESETS, load_preset


@pytest.mark.parametrize("name", PRESETS)
def test_every_drive_of_a_preset_has_a_scene_name_of_its_own(name: str):
    scenes = [order.scene for order in load_preset(name).drives]
    assert len(scenes) == len(set(scenes)) > 0


def test_experiment_orders_forty_drives_named_by_the_papers_split():
    drives = load_preset("experiment").drives
    assert len(drives) == 40
    roles = {order.scene: order.role for order in drives}
    assert {scene for scene, role in roles.items() if role == "prior"} <= set(PRIOR_SCENES)
    assert {scene for scene, role in roles.items() if role == "test"} <= set(TEST_SCENES)
    assert not {scene for scene, role in roles.items() if role == "train"} & {*PRIOR_SCENES, *TEST_SCENES}


def test_training_and_testing_never_share_a_city():
    drives = load_preset("experiment").drives
    trained = {order.location for order in drives if order.role == "train"}
    assert trained.isdisjoint(order.location for order in drives if order.role != "train")


def test_test_drives_take_the_streets_of_the_prior_and_one_more():
    drives = [order for order in load_preset("experiment").drives if order.location == "singapore-onenorth"]
    mapped = {order.street for order in drives if order.role == "prior"}
    tested = {order.street for order in drives if order.role == "test"}
    assert mapped < tested
    assert len(tested) == len(mapped) + 1


def test_no_prior_is_built_at_night():
    assert all(order.light != "night" for order in load_preset("experiment").drives if order.role == "prior")


def test_settings_reach_into_towns_and_their_style():
    preset = load_preset("demo", ["keyframes=7", "towns.singapore-onenorth.style.size_m=500", "lidar=true"])
    assert (preset.keyframes, preset.lidar) == (7, True)
    assert preset.towns["singapore-onenorth"].style.size_m == 500


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("keyframs=7", "did you mean keyframes"),
        ("keyframes=1", "keyframes: .*got 1"),
        ("towns.atlantis.streets=1", "atlantis"),
        ('towns.singapore-onenorth.train=["noon"]', "noon"),
        ("towns.singapore-onenorth.style.size=500", "size"),
    ],
)
def test_a_bad_setting_is_refused_by_name(override: str, named: str):
    with pytest.raises(SettingsError, match=named):
        load_preset("demo", [override])


def test_more_drives_than_scene_names_are_refused():
    many = "[" + ",".join(['"day"'] * (len(PRIOR_SCENES) + 1)) + "]"
    with pytest.raises(SettingsError, match=r"83 prior drives, but only 82 scene names"):
        load_preset("experiment", [f"towns.singapore-onenorth.prior={many}"])
