"""A drive is for what the city's split says, and a split that does not say is refused."""

import pytest

from presight_core.config import SplitSettings, load_city_settings
from presight_core.errors import InputError, SettingsError
from presight_core.nuscenes_split import PRIOR_SCENES, TEST_SCENES
from presight_core.split import part_of

LISTS = SplitSettings(train=("scene-00*",), test=("scene-0100", "scene-02*"))


def test_without_a_split_every_drive_makes_the_prior():
    assert part_of("anything", SplitSettings()) == "prior"


@pytest.mark.parametrize(("name", "part"), [("scene-0001", "train"), ("scene-0100", "test"), ("scene-0233", "test")])
def test_a_drive_has_the_part_whose_list_names_it(name, part):
    assert part_of(name, LISTS) == part


def test_a_drive_on_no_list_is_refused_rather_than_guessed():
    with pytest.raises(SettingsError, match=r"scene-0300 is on no list.*rest"):
        part_of("scene-0300", LISTS)
    assert part_of("scene-0300", LISTS.model_copy(update={"rest": "prior"})) == "prior"


def test_a_drive_on_two_lists_is_refused():
    with pytest.raises(SettingsError, match="lists train and test"):
        part_of("scene-0001", LISTS.model_copy(update={"test": ("scene-0001",)}))


def test_the_papers_split_ships_with_its_82_prior_and_154_test_scenes():
    paper = SplitSettings(named="paper")
    parts = [part_of(f"scene-{number:04}", paper) for number in range(1, 1111)]
    assert (parts.count("prior"), parts.count("test")) == (82, 154) == (len(PRIOR_SCENES), len(TEST_SCENES))


def test_the_papers_split_knows_no_other_names():
    with pytest.raises(InputError, match="is no nuScenes scene"):
        part_of("our-drive-7", SplitSettings(named="paper"))


def test_a_named_split_beside_lists_is_refused():
    with pytest.raises(SettingsError, match="take the lists"):
        part_of("scene-0001", SplitSettings(named="paper", test=("scene-0001",)))


def test_test_drives_cannot_be_asked_to_build_a_prior(tmp_path):
    file = tmp_path / "city.toml"
    file.write_text('[split]\nbuild_from = ["prior", "test"]\n')
    with pytest.raises(SettingsError, match=r"build_from.*'train' or 'prior'"):
        load_city_settings(file)
