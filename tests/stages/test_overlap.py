"""Shared ground is counted in places, not in frames, and refused with its numbers."""

import numpy as np
import pytest

from presight_core.errors import InputError
from stages.overlap import overlap, require_apart


def street(start_m: float, end_m: float, y_m: float = 0.0) -> np.ndarray:
    x = np.arange(start_m + 2.5, end_m, 5.0)
    return np.stack([x, np.full_like(x, y_m), np.zeros_like(x)], -1)


def test_the_share_is_that_of_the_test_drives_places_near_a_train_drive():
    found = overlap(street(0, 100), {"near": street(50, 150), "far": street(1000, 1100)}, within_m=10.0)
    assert (found.test_places, found.shared_places) == (40, 11)  # ten on the same street, and one 5 m on
    assert found.share == 11 / 40
    assert found.worst == (("near", 11 / 20),)


def test_a_vehicle_that_waits_weighs_nothing():
    waiting = np.concatenate([street(50, 150), np.repeat(street(0, 5), 1000, axis=0)])
    assert overlap(street(0, 100), {"a": waiting}, 1.0).test_places == 21


def test_ground_that_is_shared_is_refused_with_the_numbers():
    found = overlap(street(0, 100), {"scene-0002": street(50, 150)}, 10.0)
    said = r"55% of the test ground \(11 of 20 places.*scene-0002 55%.*split.allow_overlap = true"
    with pytest.raises(InputError, match=said):
        require_apart("toytown", found, 10.0)


def test_parts_that_are_apart_pass():
    require_apart("toytown", overlap(street(0, 100), {"a": street(0, 100, y_m=40.0)}, 30.0), 30.0)


def test_a_part_without_drives_overlaps_nothing():
    assert overlap(np.empty((0, 3)), {"a": street(0, 10)}, 10.0).share == 0.0
    assert overlap(street(0, 10), {}, 10.0).share == 0.0
