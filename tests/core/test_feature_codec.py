"""The compact code of features: what goes in comes out, below a limit, and damage is an error."""

import numpy as np
import pytest

from presight_core import feature_codec
from presight_core.feature_codec import range_coder

ONES = np.ones(6, np.float32)


def features(rows: int = 24, columns: int = 40, noise: float = 8.0) -> np.ndarray:
    """Smooth channels with some noise, as networks give them."""
    generator = np.random.default_rng(0)
    row, column, channel = np.meshgrid(np.arange(rows), np.arange(columns), np.arange(6), indexing="ij")
    smooth = 128 + 80 * np.sin(row / 6 + channel) * np.cos(column / (7 + channel))
    return np.clip(smooth + generator.normal(0, noise, smooth.shape), 0, 255).astype(np.uint8)


def error(values: np.ndarray, decoded: np.ndarray) -> float:
    return float(np.sqrt(np.mean((values.astype(float) - decoded) ** 2)))


@pytest.mark.parametrize("largest", [1, 20, 3000])
def test_coefficients_come_back_exactly(largest):
    values = np.random.default_rng(largest).integers(-largest, largest + 1, (3, 2, 4, 8, 8)).astype(np.int32)
    np.testing.assert_array_equal(range_coder.decode(range_coder.encode(values), values.shape), values)


def test_a_rare_coefficient_costs_little():
    values = np.zeros((8, 4, 4, 8, 8), np.int32)
    values[3, 1, 1, 0, 0] = -5
    assert len(range_coder.encode(values)) < 200  # 8192 coefficients, nearly all of them a certain zero


def test_a_carry_through_many_bytes_survives():
    generator = np.random.default_rng(1)
    for seed in range(20):
        values = generator.geometric(0.02, (1, 2, 2, 8, 8)).astype(np.int32) * (-1) ** seed
        np.testing.assert_array_equal(range_coder.decode(range_coder.encode(values), values.shape), values)


@pytest.mark.parametrize(("rows", "columns"), [(24, 40), (28, 50), (1, 1), (9, 7)])
def test_features_of_any_size_come_back_about_as_they_were(rows, columns):
    values = features(rows, columns)
    decoded = feature_codec.decode(feature_codec.encode(values, ONES))
    assert decoded.shape == values.shape
    assert error(values, decoded) < 12  # a step of 32 rounds by up to 16


def test_the_code_stays_below_its_limit():
    values = features(noise=60)
    for limit in (600, 1500):
        assert len(feature_codec.encode(values, ONES, limit)) <= limit


def test_the_limit_is_used_where_the_features_are_noise():
    values = features(noise=60)
    assert len(feature_codec.encode(values, ONES, 1500)) > 1200


def test_more_bytes_mean_a_smaller_error():
    values, limits = features(noise=30), (400, 700, 1000, 1400)
    errors = [error(values, feature_codec.decode(feature_codec.encode(values, ONES, limit))) for limit in limits]
    assert errors == sorted(errors, reverse=True)


def test_a_heavier_channel_is_kept_better():
    weights = np.array([4, 1, 1, 1, 1, 1], np.float32)
    values = features(noise=30)
    decoded = feature_codec.decode(feature_codec.encode(values, weights, 700))
    assert error(values[..., 0], decoded[..., 0]) < 0.7 * error(values[..., 1:], decoded[..., 1:])


def test_constant_features_are_exact():
    values = np.full((16, 16, 6), 77, np.uint8)
    np.testing.assert_array_equal(feature_codec.decode(feature_codec.encode(values, ONES)), values)


def test_the_same_features_give_the_same_code():
    assert feature_codec.encode(features(), ONES) == feature_codec.encode(features(), ONES)


def test_weights_follow_the_ranges_but_only_somewhat():
    weights = feature_codec.channel_weights([16.0, 1.0])
    assert weights[0] / weights[1] == pytest.approx(2.0)
    assert np.prod(weights) == pytest.approx(1.0)


@pytest.mark.parametrize("damage", [b"", b"\x02" + bytes(40), b"\x01" + b"\xff" * 6, b"\x01\x08\x00\x08\x00\x06\x00"])
def test_what_was_never_encoded_is_refused(damage):
    with pytest.raises(ValueError, match="compact features"):
        feature_codec.decode(damage)


def test_a_damaged_body_gives_numbers_or_an_error_but_never_a_crash():
    code = feature_codec.encode(features(), ONES)
    generator = np.random.default_rng(0)
    for _ in range(20):
        damaged = bytearray(code)
        damaged[generator.integers(30, len(code))] ^= 1 << generator.integers(8)
        try:
            assert feature_codec.decode(bytes(damaged)).shape == (24, 40, 6)
        except ValueError as error_:
            assert "damaged" in str(error_)
