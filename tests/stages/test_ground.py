"""Where rays must end that show the ground."""

import numpy as np
import pytest

from presight_core.classes import CITYSCAPES
from presight_core.config import GroundSettings
from stages.ground import Ground
from stages.ray_pool import PixelBatch

SETTINGS = GroundSettings(weight=0.01, camera_height_m=1.5, tolerance_m=0.1, curb_m=0.2, reach_m=10.0)
STREET = np.stack([np.arange(0.0, 20.0), np.zeros(20), np.full(20, 1.5)], -1)  # cameras 1.5 m above z = 0
ROAD, SIDEWALK, CAR = (CITYSCAPES.index(name) for name in ("road", "sidewalk", "car"))


def look_down(label: int, descent: float = 0.5, origin: tuple[float, float, float] = (5.0, 0.0, 1.5)) -> PixelBatch:
    """One ray from the street that descends by `descent` a metre of its length."""
    direction = np.array([[np.sqrt(1 - descent**2), 0.0, -descent]])
    colours, features = np.zeros((1, 3), np.uint8), np.zeros((1, 2), np.uint8)
    return PixelBatch(
        np.zeros(1, np.int64),
        np.array([origin]),
        direction,
        np.zeros(1),
        colours,
        np.array([label], np.uint8),
        features,
    )


@pytest.fixture
def ground() -> Ground:
    return Ground(STREET, SETTINGS)


def test_a_road_ray_ends_within_the_tolerance_of_the_road(ground):
    (start,), (end,) = ground.stretches(look_down(ROAD))
    assert (start, end) == pytest.approx((1.4 / 0.5, 1.6 / 0.5))


def test_a_sidewalk_may_be_a_curb_higher(ground):
    (start,), (end,) = ground.stretches(look_down(SIDEWALK))
    assert (start, end) == pytest.approx((1.2 / 0.5, 1.6 / 0.5))


@pytest.mark.parametrize(
    "batch",
    [
        pytest.param(look_down(CAR), id="another class"),
        pytest.param(look_down(ROAD, descent=0.01), id="nearly level"),
        pytest.param(look_down(ROAD, origin=(5.0, 50.0, 1.5)), id="far from every camera"),
        pytest.param(look_down(ROAD, origin=(5.0, 0.0, 0.2)), id="origin at the ground"),
    ],
)
def test_nothing_is_known_of_other_rays(ground, batch):
    (start,), (end,) = ground.stretches(batch)
    assert (start, end) == (0, np.inf)


def test_the_ground_follows_the_cameras_uphill():
    hill = STREET + np.array([0.0, 0.0, 1.0]) * STREET[:, :1] * 0.1  # one metre up in ten
    origin = (5.0, 0.0, 2.0)
    (start,), (end,) = Ground(hill, SETTINGS).stretches(look_down(ROAD, descent=0.2, origin=origin))
    landing_x_m = 5.0 + 1.5 / 0.2 * np.sqrt(1 - 0.2**2)
    ground_z_m = round(landing_x_m) * 0.1  # mean height of the places around it, to a few centimetres
    assert start < (2.0 - ground_z_m) / 0.2 < end
