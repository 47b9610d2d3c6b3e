"""What a new tile must show before it may be published."""

from dataclasses import replace

import numpy as np
import pytest

from presight_core.config import ValidationSettings
from presight_core.priors.schema import pack_columns
from presight_core.priors.summary import TileSummary
from stages.validation import validate_tile

SETTINGS = ValidationSettings(min_voxels=100, min_psnr_db=12.0, min_coverage=0.8)
GOOD = {"psnr_db": 24.0, "loss": 0.01}


def summary(observed_rows: int, voxel_count: int = 1000) -> TileSummary:
    """One block of which so many rows of columns were observed."""
    observed = np.zeros((1, 32, 32), np.bool_)
    observed[0, :observed_rows] = True
    return TileSummary(voxel_count, np.zeros((1, 2), np.int32), pack_columns(observed))


def test_a_good_first_tile_may_be_published():
    assert validate_tile(summary(10), GOOD, None, SETTINGS) == ()


def test_a_tile_without_held_out_frames_is_judged_by_the_rest():
    assert validate_tile(summary(10), {"loss": 0.01}, None, SETTINGS) == ()


@pytest.mark.parametrize(
    ("new", "metrics", "fact"),
    [
        (summary(10, voxel_count=99), GOOD, "99 voxels"),
        (summary(10), {"psnr_db": 11.9}, "11.9 dB"),
        (summary(10), {"psnr_db": float("nan")}, "not a number: psnr_db"),
        (summary(10), {**GOOD, "loss": float("inf")}, "not a number: loss"),
        (summary(7), GOOD, "70% of the observed columns"),
    ],
    ids=["few voxels", "poor images", "psnr is nan", "loss is infinite", "lost ground"],
)
def test_each_fault_is_one_problem(new: TileSummary, metrics: dict, fact: str):
    (problem,) = validate_tile(new, metrics, summary(10), SETTINGS)
    assert fact in problem


def test_losing_a_fifth_of_the_ground_is_still_allowed():
    assert validate_tile(summary(8), GOOD, summary(10), SETTINGS) == ()


def test_new_ground_does_not_make_up_for_lost_ground():
    larger_elsewhere = replace(summary(32), block_index=np.array([[5, 5]], np.int32))
    (problem,) = validate_tile(larger_elsewhere, GOOD, summary(10), SETTINGS)
    assert "0% of the observed columns" in problem
