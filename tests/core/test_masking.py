"""Masking: what can move, its margin and its shadow get a dynamic class; the rest keeps its labels."""

import numpy as np

from presight_core import classes, masking
from presight_core.config import FeatureSettings

ROAD, CAR, SKY = 0, 13, 10
DYNAMIC = classes.lookup(classes.DYNAMIC)


def street() -> tuple[np.ndarray, np.ndarray]:
    """A car on a grey road, a dark spot beside it and another one far away."""
    labels = np.full((100, 160), ROAD, np.uint8)
    labels[:30] = SKY
    labels[50:60, 40:60] = CAR
    rgb = np.full((200, 320, 3), 120, np.uint8)
    rgb[120:128, 80:120] = 40  # the shadow: rows 60..63 of the labels, right below the car
    rgb[180:190, 200:220] = 40
    return labels, rgb


def test_without_a_margin_labels_stay_as_they_are():
    labels, rgb = street()
    settings = FeatureSettings(dynamic_margin=0)
    np.testing.assert_array_equal(masking.masked_labels(labels, rgb, settings), labels)


def test_the_margin_is_a_share_of_the_height_on_all_sides():
    labels, rgb = street()
    masked = DYNAMIC[masking.masked_labels(labels, rgb, FeatureSettings(dynamic_margin=0.03))]
    rows, columns = np.nonzero(masked)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (47, 62, 37, 62)


def test_nothing_but_the_margin_changes():
    labels, rgb = street()
    changed = masking.masked_labels(labels, rgb, FeatureSettings(dynamic_margin=0.03))
    same = ~DYNAMIC[changed] | DYNAMIC[labels]
    np.testing.assert_array_equal(changed[same], labels[same])


def test_a_shadow_beside_a_car_is_masked_and_other_dark_ground_is_not():
    labels, rgb = street()
    settings = FeatureSettings(dynamic_margin=0, mask_shadows=True)
    masked = DYNAMIC[masking.masked_labels(labels, rgb, settings)]
    assert masked[60:64, 41:59].all()
    assert not masked[90:95, 100:110].any()
    assert not masked[66:].any()


def test_classes_that_may_stay_are_not_masked():
    labels, rgb = street()
    settings = FeatureSettings(dynamic_classes=("person",), dynamic_margin=0.03)
    np.testing.assert_array_equal(masking.masked_labels(labels, rgb, settings), labels)


def test_the_masked_share_counts_the_margin():
    labels, rgb = street()
    settings = FeatureSettings(dynamic_margin=0.03)
    bare, grown = labels, masking.masked_labels(labels, rgb, settings)
    assert masking.masked_share(bare, settings) == 200 / 16000
    assert masking.masked_share(grown, settings) > 300 / 16000
