"""The paper's split by scene name."""

import pytest

from presight_core.errors import InputError
from presight_core.nuscenes_split import PRIOR_SCENES, TEST_SCENES, role_of


def test_the_lists_have_the_papers_lengths_and_do_not_overlap():
    assert len(PRIOR_SCENES) == len(set(PRIOR_SCENES)) == 82  # 63 of onenorth, 19 of hollandvillage
    assert len(TEST_SCENES) == len(set(TEST_SCENES)) == 154  # 120 of onenorth, 34 of hollandvillage
    assert not set(PRIOR_SCENES) & set(TEST_SCENES)


@pytest.mark.parametrize(("scene", "role"), [("scene-0988", "prior"), ("scene-1104", "test"), ("scene-0061", "test")])
def test_listed_scenes_have_their_role(scene, role):
    assert role_of(scene) == role


def test_any_other_scene_trains():
    assert role_of("scene-0103") == "train"


def test_what_is_no_scene_has_no_role():
    with pytest.raises(InputError, match="scene-"):
        role_of("n015-2018-07-24")
