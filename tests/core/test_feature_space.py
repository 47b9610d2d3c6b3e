from dataclasses import replace

import numpy as np

from presight_core.feature_space import FeatureSpace


def space() -> FeatureSpace:
    return FeatureSpace(
        mean=np.array([1.0, 2.0, 3.0], np.float32),
        components=np.array([[1, 0, 0], [0, 1, 0]], np.float32),
        low=np.array([-1.0, -2.0], np.float32),
        high=np.array([1.0, 2.0], np.float32),
        explained=np.array([0.7, 0.2], np.float32),
        model_sha256="0" * 64,
    )


def test_the_mean_maps_to_the_middle_of_the_range():
    assert space().encode([1.0, 2.0, 3.0]).tolist() == [128, 128]


def test_values_beyond_the_range_are_clipped():
    assert space().encode([[9.0, -9.0, 0.0]]).tolist() == [[255, 0]]


def test_the_name_changes_with_every_number_and_with_the_model():
    names = {
        space().space_id,
        replace(space(), model_sha256="1" * 64).space_id,
        replace(space(), high=np.array([1.0, 2.1], np.float32)).space_id,
    }
    assert len(names) == 3
