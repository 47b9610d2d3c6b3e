"""What a new tile must show before it may be published."""

from dataclasses import replace

import pytest

from presight_core.config import ValidationSettings
from presight_core.priors.agreement import Agreement
from stages.validation import judge_build, judge_change, psnr_change_db

SETTINGS = ValidationSettings(
    min_voxels=100, min_psnr_db=12.0, min_coverage=0.8, min_geometry=0.6, min_feature_cosine=0.5, max_psnr_loss_db=1.0
)
GOOD = {"psnr_db": 24.0, "loss": 0.01}
ALIKE = Agreement(coverage=0.8, old_found=0.7, new_found=0.6, feature_cosine=0.5)


def test_a_good_first_tile_may_be_published():
    assert judge_build(100, GOOD, SETTINGS) == ()
    assert judge_change(None, None, SETTINGS) == ()


def test_a_tile_without_held_out_frames_is_judged_by_the_rest():
    assert judge_build(100, {"loss": 0.01}, SETTINGS) == ()


@pytest.mark.parametrize(
    ("voxels", "metrics", "fact"),
    [
        (99, GOOD, "99 voxels"),
        (100, {"psnr_db": 11.9}, "11.9 dB"),
        (100, {"psnr_db": float("nan")}, "not a number: psnr_db"),
        (100, {**GOOD, "loss": float("inf")}, "not a number: loss"),
    ],
    ids=["few voxels", "poor images", "psnr is nan", "loss is infinite"],
)
def test_each_fault_of_a_build_is_one_problem(voxels: int, metrics: dict, fact: str):
    (problem,) = judge_build(voxels, metrics, SETTINGS)
    assert fact in problem


def test_a_build_like_the_old_one_may_replace_it():
    assert judge_change(ALIKE, -1.0, SETTINGS) == ()


@pytest.mark.parametrize(
    ("name", "value", "fact"),
    [
        ("coverage", 0.7, "keeps 70% of the observed columns"),
        ("old_found", 0.5, "50% of the old voxels and 60% of the new ones"),
        ("new_found", 0.5, "70% of the old voxels and 50% of the new ones"),
        ("feature_cosine", 0.4, "cosine of old and new features 0.40"),
    ],
)
def test_each_difference_from_the_old_build_is_one_problem(name: str, value: float, fact: str):
    (problem,) = judge_change(replace(ALIKE, **{name: value}), None, SETTINGS)
    assert fact in problem


def test_worse_images_are_a_problem():
    (problem,) = judge_change(None, -1.1, SETTINGS)
    assert "1.1 dB worse" in problem


def test_images_are_compared_by_the_drives_that_both_builds_have():
    assert psnr_change_db({"a": 20.0, "b": 22.0, "gone": 5.0}, {"a": 21.0, "b": 21.0, "night": 9.0}) == 0.0
    assert psnr_change_db({"a": 20.0}, {"b": 20.0}) is None
