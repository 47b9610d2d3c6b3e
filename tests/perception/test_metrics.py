"""Metrics on cases small enough to work out by hand."""

import math
import tracemalloc

import numpy as np
import pytest

from presight_core.errors import InputError
from presight_perception.metrics import OccupancyIou, RasterIou, ScoredLines, VectorPrecision, VectorSettings
from presight_perception.metrics.polyline import chamfer_m, chamfer_matrix_m, resample
from presight_perception.metrics.vector_precision import average_precision, match
from presight_perception.occupancy_truth import OCCUPANCY_CLASSES, OccupancyTruth


def straight(y: float, length: float = 10.0) -> np.ndarray:
    return np.array([[0.0, y], [length, y]])


def scored(*lines: tuple[float, float], label: int = 1) -> ScoredLines:
    """Straight lines given by y and score."""
    return ScoredLines(
        [straight(y) for y, _ in lines], np.full(len(lines), label), np.array([score for _, score in lines])
    )


def test_resampling_takes_equal_steps_around_corners():
    found = resample(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 3.0]]), 5)
    np.testing.assert_allclose(found, [[0, 0], [1, 0], [1, 1], [1, 2], [1, 3]])


def test_a_line_of_no_length_is_resampled_to_its_place():
    np.testing.assert_array_equal(resample(np.array([[2.0, 3.0], [2.0, 3.0]]), 4), [[2.0, 3.0]] * 4)


def test_chamfer_of_parallel_lines_is_their_distance_whatever_the_direction():
    assert chamfer_m(resample(straight(0), 200), resample(straight(2)[::-1], 200)) == pytest.approx(2)


def test_the_limit_hides_no_near_pair():
    random = np.random.default_rng(0)
    lines = [resample(random.uniform(-6, 6, (4, 2)), 50) for _ in range(12)]
    whole = np.array([[chamfer_m(a, b) for b in lines] for a in lines])
    limited = chamfer_matrix_m(lines, lines, 3.0)
    assert np.isinf(limited).any()
    assert (whole[np.isinf(limited)] > 3.0).all()
    np.testing.assert_array_equal(limited[~np.isinf(limited)], whole[~np.isinf(limited)])


def test_a_second_prediction_of_the_same_line_is_false_even_if_another_line_is_near():
    distances = np.array([[0.1, 0.9], [0.2, 0.3]])
    assert match(distances, np.array([0.9, 0.8]), 1.0).tolist() == [True, False]
    assert match(distances, np.array([0.8, 0.9]), 1.0).tolist() == [False, True]


def test_average_precision_is_the_area_under_the_envelope():
    found = np.array([True, False, True])  # precision 1, 1/2, 2/3 at recall 1/4, 1/4, 1/2
    assert average_precision(found, 4) == pytest.approx(0.25 * 1 + 0.25 * 2 / 3)


def test_average_precision_sorts_over_all_samples():
    precision = VectorPrecision(VectorSettings((1.0,)))
    precision.add(scored((0.0, 0.5), (8.0, 0.9)), {"divider": [straight(0)]})
    precision.add(scored((0.5, 0.7)), {"divider": [straight(0)]})
    scores = precision.result()
    assert scores.per_class == {"ped_crossing": 0, "divider": pytest.approx(2 / 3), "boundary": 0}
    assert scores.mean == pytest.approx(2 / 9)


def test_the_larger_range_has_the_larger_thresholds():
    assert VectorSettings.for_range(60, 30).thresholds_m == (0.5, 1.0, 1.5)
    assert VectorSettings.for_range(100, 50).thresholds_m == (1.0, 1.5, 2.0)


def test_a_range_without_thresholds_is_an_error():
    with pytest.raises(InputError, match="80 x 40 m"):
        VectorSettings.for_range(80, 40)


def test_raster_sums_over_samples_before_dividing():
    iou = RasterIou(("line",))
    iou.add(np.array([[[1, 1, 0, 0]]]), np.array([[[1, 0, 0, 0]]]))
    iou.add(np.array([[[1, 1, 1, 1]]]), np.array([[[1, 1, 1, 1]]]))
    assert iou.result().mean == pytest.approx(5 / 6)


def test_raster_masks_of_different_shapes_are_an_error():
    with pytest.raises(InputError, match="both must be"):
        RasterIou().add(np.zeros((3, 4, 4)), np.zeros((3, 4, 5)))


def occupancy(*classes: str) -> OccupancyTruth:
    semantics = np.array([[[OCCUPANCY_CLASSES.index(name) for name in classes]]], np.uint8)
    everywhere = np.ones(semantics.shape, np.bool_)
    return OccupancyTruth(semantics, everywhere, everywhere)


def scores_of(predicted: OccupancyTruth, truth: OccupancyTruth):
    iou = OccupancyIou()
    iou.add(predicted.semantics, truth)
    return iou.result()


def test_a_class_without_true_voxels_counts_as_each_mean_says():
    scores = scores_of(occupancy("car", "trailer", "manmade"), occupancy("car", "car", "manmade"))
    assert scores.per_class["trailer"] == 0
    assert math.isnan(scores.per_class["bus"])
    assert scores.mean() == pytest.approx((0.5 + 1) / 2)
    assert scores.mean(absent="zero if predicted") == pytest.approx((0.5 + 0 + 1) / 3)
    assert scores.mean(absent="zero") == pytest.approx((0.5 + 1) / 17)
    assert scores.summary() == {"dynamic": 0.5, "static": 1.0, "overall": 0.75}
    assert scores.summary("zero")["dynamic"] == pytest.approx(0.5 / 11)


def test_means_of_absent_classes_alone_are_undefined():
    assert math.isnan(scores_of(occupancy("free"), occupancy("free")).mean())


def test_voxels_outside_the_mask_do_not_count():
    truth = OccupancyTruth(np.full((2, 1, 1), 4, np.uint8), np.array([[[True]], [[False]]]), np.ones((2, 1, 1), bool))
    predicted = np.array([[[4]], [[5]]], np.uint8)
    for mask, count in (("camera", 1), ("lidar", 2), ("none", 2)):
        iou = OccupancyIou(mask)
        iou.add(predicted, truth)
        assert iou.histogram.sum() == count


def test_a_predicted_class_that_does_not_exist_is_an_error():
    with pytest.raises(InputError, match="0 to 17"):
        OccupancyIou().add(np.full((1, 1, 1), 18), occupancy("car"))


def test_evaluation_remembers_no_sample():
    """The whole of a data set costs what one sample costs."""
    random = np.random.default_rng(0)
    semantics = random.integers(0, 18, (40, 40, 16), np.uint8)
    truth = OccupancyTruth(semantics, semantics < 9, semantics < 12)
    iou = OccupancyIou()
    iou.add(semantics, truth)
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    for _ in range(50):
        iou.add(semantics, truth)
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert grown < semantics.nbytes
