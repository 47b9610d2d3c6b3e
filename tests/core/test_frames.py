import numpy as np
import pytest

from presight_core import frames


@pytest.fixture
def world_from_ego() -> np.ndarray:
    rotation = frames.rotation_from_quaternion([0.9, 0.1, -0.2, 0.3])
    return frames.transform(rotation, [400.0, 1200.0, 0.5])


def test_invert_undoes_the_transform(world_from_ego):
    points_ego = np.random.default_rng(0).normal(size=(50, 3)) * 30
    points_world = frames.apply(world_from_ego, points_ego)
    np.testing.assert_allclose(frames.apply(frames.invert(world_from_ego), points_world), points_ego, atol=1e-10)


def test_a_quaternion_survives_the_round_trip_at_any_angle():
    for quaternion in np.random.default_rng(1).normal(size=(200, 4)):
        unit = quaternion / np.linalg.norm(quaternion)
        again = frames.quaternion_from_rotation(frames.rotation_from_quaternion(quaternion))
        np.testing.assert_allclose(abs(again @ unit), 1, atol=1e-12)


def test_a_half_turn_has_a_quaternion():
    half_turn = np.diag([-1.0, -1.0, 1.0])
    np.testing.assert_allclose(np.abs(frames.quaternion_from_rotation(half_turn)), [0, 0, 0, 1], atol=1e-12)


def test_positive_yaw_turns_left():
    world_from_ego = frames.planar_transform(10, 20, np.pi / 2)
    np.testing.assert_allclose(frames.apply(world_from_ego, [[1, 0, 0]]), [[10, 21, 0]], atol=1e-12)


@pytest.mark.parametrize(
    "fault",
    [
        np.diag([1.0, 1.0, -1.0, 1.0]),
        np.diag([2.0, 2.0, 2.0, 1.0]),
        np.full((4, 4), np.nan),
    ],
    ids=["left-handed", "scaled", "NaN"],
)
def test_only_rigid_transforms_pass(fault, world_from_ego):
    assert frames.is_rigid(np.stack([world_from_ego, fault])).tolist() == [True, False]
