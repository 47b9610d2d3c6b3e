"""Artifacts: feature spaces come back exactly, under their own name, and a pin never moves."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest

from presight_core.errors import NotFoundError, StoreError
from presight_core.feature_space import FeatureSpace
from storage.artifacts import Artifacts


@pytest.fixture
def space() -> FeatureSpace:
    generator = np.random.default_rng(0)
    shapes = {"mean": 6, "components": (3, 6), "low": 3, "high": 3, "explained": 3}
    arrays = {name: generator.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    return FeatureSpace(**arrays, model_sha256="a" * 64)


@pytest.fixture
def artifacts(tmp_path) -> Artifacts:
    return Artifacts(tmp_path)


def test_a_space_comes_back_bit_for_bit(artifacts, space):
    read = artifacts.space(artifacts.save_space(space))
    for field in fields(FeatureSpace):
        np.testing.assert_array_equal(getattr(read, field.name), getattr(space, field.name))


def test_a_space_whose_numbers_lie_column_by_column_comes_back_too(artifacts, space):
    turned = replace(space, components=np.asfortranarray(space.components))
    read = artifacts.space(artifacts.save_space(turned))
    np.testing.assert_array_equal(read.components, space.components)


def test_saving_again_changes_nothing(artifacts, space):
    assert artifacts.save_space(space) == artifacts.save_space(space) == space.space_id
    assert artifacts.has_space(space.space_id)


def test_an_unknown_space_is_named(artifacts):
    assert not artifacts.has_space("0" * 16)
    with pytest.raises(NotFoundError, match="no feature space 0000000000000000"):
        artifacts.space("0" * 16)


def test_a_space_under_a_name_that_is_not_its_own_is_damage(artifacts, space, tmp_path):
    artifacts.save_space(space)
    other = replace(space, low=space.low + 1).space_id
    (tmp_path / "spaces" / space.space_id).rename(tmp_path / "spaces" / other)
    with pytest.raises(StoreError, match=f"its content has the id {space.space_id}"):
        artifacts.space(other)


def test_a_cut_file_is_damage(artifacts, space, tmp_path):
    artifacts.save_space(space)
    file = tmp_path / "spaces" / space.space_id / "space.safetensors"
    file.write_bytes(file.read_bytes()[:-8])
    with pytest.raises(StoreError, match="cannot be read"):
        artifacts.space(space.space_id)


def test_the_first_pin_of_a_choice_stays(artifacts, tmp_path):
    key = {"feature_model": "a" * 64, "channels": 64}
    assert artifacts.pinned_space(key) is None
    assert artifacts.pin_space(key, "first") == "first"
    assert artifacts.pin_space(key, "second") == "first"
    assert artifacts.pinned_space(dict(reversed(key.items()))) == "first"
    assert artifacts.pinned_space({**key, "channels": 32}) is None
    assert [json.loads(file.read_text())["key"] for file in (tmp_path / "pins").iterdir()] == [key]
