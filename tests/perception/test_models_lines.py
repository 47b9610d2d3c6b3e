"""True lines, matching and losses of the vector models."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
import torch

from presight_perception.models.bev_grid import BevGrid
from presight_perception.models.line_loss import (
    LineLossSettings,
    LinePredictions,
    coordinate_costs,
    focal_loss,
    line_losses,
    match_lines,
)
from presight_perception.models.line_truth import LineSettings, LineTruth, line_truth, orders_of
from tests.perception import toy_rig

SQUARE = np.array([[0.0, 0], [4, 0], [4, 4], [0, 4], [0, 0]])
OPEN = np.array([[0.0, 0], [1, 0], [6, 0]])
STREAM, MAP_TR = LineSettings(9), LineSettings(9, "vertices")
MAP_TR_LOSS = LineLossSettings(2.0, 5.0, 0.0, 0.005)
GRID = BevGrid(20.0, 10.0, 5, 10)


def predictions(truth: LineTruth, query_count: int = 5, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    random = torch.Generator().manual_seed(seed)
    points = truth.lines.shape[2]
    return torch.randn(query_count, 3, generator=random), torch.rand(query_count, points, 2, generator=random)


def perfect(truth: LineTruth, order: int) -> LinePredictions:
    """Sure and exact predictions, after the lines of which there is a query for nothing."""
    logits = torch.full((len(truth.labels) + 1, 3), -30.0)
    logits[torch.arange(len(truth.labels)), truth.labels] = 30.0
    lines = torch.cat([truth.lines[:, order], torch.rand(1, *truth.lines.shape[2:])])
    return LinePredictions(logits[None, None], lines[None, None])


def test_an_open_line_has_two_orders_at_equal_steps():
    orders = orders_of(OPEN, replace(STREAM, point_count=4))
    np.testing.assert_allclose(orders[..., 0], [[0, 2, 4, 6], [6, 4, 2, 0]])


def test_a_closed_line_begins_anywhere_and_runs_either_way():
    orders = orders_of(SQUARE, STREAM)
    assert len(orders) == 2 * (9 - 1)
    assert len(np.unique(orders.reshape(len(orders), -1), axis=0)) == len(orders)
    np.testing.assert_allclose(orders[:, 0], orders[:, -1])


def test_a_closed_line_begins_at_its_vertices_and_keeps_its_direction_in_map_tr():
    orders = orders_of(SQUARE, MAP_TR)
    np.testing.assert_allclose(orders[:, 0], SQUARE[:4])
    areas = [np.cross(order[:-1], order[1:]).sum() / 2 for order in np.pad(orders, ((0, 0), (0, 0), (0, 1)))]
    np.testing.assert_allclose(areas, 16)


def test_more_vertices_than_orders_are_thinned():
    angles = np.linspace(0, 2 * np.pi, 41)
    circle = np.stack([np.cos(angles), np.sin(angles)], -1)
    assert len(orders_of(circle, MAP_TR)) == 8


def test_true_lines_are_shares_of_the_grid_that_grow_to_the_front_and_left():
    truth = line_truth(
        {"ped_crossing": [], "divider": [np.array([[-10.0, -5], [5, 2.5]])], "boundary": []}, GRID, STREAM
    )
    assert truth.labels.tolist() == [1]
    torch.testing.assert_close(truth.lines[0, 0, [0, -1]], torch.tensor([[0.0, 0.0], [0.75, 0.75]]))


def test_a_sample_without_lines_has_empty_truth():
    truth = line_truth({"ped_crossing": [], "divider": [], "boundary": []}, GRID, STREAM)
    assert truth.lines.shape[0] == len(truth.labels) == 0


@pytest.mark.parametrize("settings", [LineLossSettings(), MAP_TR_LOSS])
def test_matching_is_as_cheap_as_the_cheapest_of_all_assignments(settings):
    truth = line_truth(toy_rig.lines(), toy_rig.GRID, STREAM)
    logits, lines = predictions(truth)

    def cost(query: int, row: int, order: int) -> float:
        """Straight from the definitions: focal loss of naming less that of not naming, and smooth or plain L1."""
        share = logits[query, truth.labels[row]].sigmoid().double()
        named, unnamed = -0.25 * (1 - share) ** 2 * share.log(), -0.75 * share**2 * (1 - share).log()
        difference = (lines[query] - truth.lines[row, order]).abs().double()
        if settings.smooth:
            beta = settings.smooth
            difference = torch.where(difference < beta, difference**2 / (2 * beta), difference - beta / 2)
        return float(settings.class_weight * (named - unnamed) + settings.coordinate_weight * difference.sum())

    order_count = truth.lines.shape[1]
    best = [[min(cost(query, row, order) for order in range(order_count)) for row in range(4)] for query in range(5)]
    least = min(sum(best[query][row] for row, query in enumerate(chosen)) for chosen in permutations(range(5), 4))
    match = match_lines(logits, lines, truth, settings)
    found = sum(cost(*(int(part) for part in pair)) for pair in zip(*match, strict=True))
    assert found == pytest.approx(least, rel=1e-4)


def test_plain_and_smooth_costs_meet_far_from_zero():
    truth = line_truth(toy_rig.lines(), toy_rig.GRID, STREAM)
    _, lines = predictions(truth)
    torch.testing.assert_close(coordinate_costs(lines, truth.lines, 1e-9), coordinate_costs(lines, truth.lines, 0.0))


@pytest.mark.parametrize("settings", [LineLossSettings(), MAP_TR_LOSS])
@pytest.mark.parametrize("order", [0, 1])
def test_the_truth_in_any_of_its_orders_costs_nothing(settings, order):
    truth = line_truth(toy_rig.lines(), toy_rig.GRID, STREAM)
    losses = line_losses(perfect(truth, order), [truth], toy_rig.GRID, settings)
    assert all(float(loss) == pytest.approx(0.0, abs=1e-5) for loss in losses.values())


def test_the_truth_backwards_in_a_closed_line_costs_where_direction_is_kept():
    truth = line_truth({"ped_crossing": [SQUARE], "divider": [], "boundary": []}, GRID, MAP_TR)
    backwards = truth._replace(lines=truth.lines.flip(2))
    assert line_losses(perfect(backwards, 0), [truth], GRID, MAP_TR_LOSS)["line"] > 1


def test_focal_loss_equals_its_formula():
    logits, targets = torch.tensor([0.3, -1.2]), torch.tensor([1.0, 0.0])
    first, second = torch.sigmoid(logits).tolist()
    expected = -0.25 * (1 - first) ** 2 * np.log(first) - 0.75 * second**2 * np.log(1 - second)
    assert focal_loss(logits, targets).item() == pytest.approx(expected, rel=1e-5)


def test_direction_counts_segments_that_run_the_wrong_way():
    truth = line_truth({"ped_crossing": [], "divider": [OPEN], "boundary": []}, GRID, STREAM)
    wrong = perfect(truth, 0)
    wrong.lines[0, 0, 0, 4, 0] = wrong.lines[0, 0, 0, 6, 0]  # steps back once
    losses = line_losses(wrong, [truth], GRID, replace(MAP_TR_LOSS, direction_weight=1.0))
    assert losses["direction"].item() == pytest.approx(2.0, abs=1e-4)


@pytest.mark.parametrize("settings", [LineLossSettings(), MAP_TR_LOSS])
def test_samples_without_lines_still_teach_the_classes(settings):
    truth = line_truth({"ped_crossing": [], "divider": [], "boundary": []}, GRID, STREAM)
    logits, lines = (torch.rand(2, 1, 4, 3, requires_grad=True), torch.rand(2, 1, 4, 9, 2, requires_grad=True))
    losses = line_losses(LinePredictions(logits, lines), [truth], GRID, settings)
    sum(losses.values(), torch.zeros(())).backward()
    assert losses["class"] > 0
    assert losses["line"] == 0
    assert lines.grad is not None
