"""From pixels to cells: where cameras see what, and that nothing is mirrored on the way."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from presight_core.errors import SettingsError
from presight_perception.models.attention import AttentionSettings, DeformableAttention
from presight_perception.models.bev_grid import BevGrid
from presight_perception.models.camera_rig import CameraRig
from presight_perception.models.view_transform import BevFormer, BevFormerSettings, BilinearLift, LiftSettings
from presight_perception.voxelise import BevAugmentation
from tests.perception import toy_rig

GRID, SIZE = toy_rig.GRID, toy_rig.SIZE
ROAD = (0.0,)  # a pillar of one point, on the road
LEFT_AHEAD = (4, 10)  # row and column of the cell around x = 9 m, y = 3 m
PIXEL_OF_LEFT_AHEAD = (32 - 32 * 3 / 9, 16 + 32 * 1.5 / 9)  # x and y in a picture of 64 x 32, seen from 1.5 m


def bev_former(settings: BevFormerSettings) -> BevFormer:
    """Cells that look neither at each other nor beside their pillars."""
    torch.manual_seed(0)
    module = BevFormer(settings, GRID, 8, (2, 1)).eval()
    for name, weight in module.named_parameters():
        if "self_attention.output" in name or "offsets" in name:
            torch.nn.init.zeros_(weight)
    return module


def test_a_point_ahead_on_the_left_is_seen_left_of_the_middle_and_below_the_horizon():
    places, seen = toy_rig.rig(1).project(torch.tensor([9.0, 3.0, 0.0]), SIZE)
    np.testing.assert_allclose(places[0, 0] * torch.tensor([64, 32]), PIXEL_OF_LEFT_AHEAD, rtol=1e-5)
    assert seen[0].tolist() == [True, False]  # the second camera looks back


def test_points_behind_a_camera_are_unseen_and_far_outside():
    places, seen = toy_rig.rig(1).project(torch.tensor([[-9.0, 0.0, 1.5]]), SIZE)
    assert not seen[0, 0]
    assert (places[0, 0] == -1).all()


def test_a_resized_picture_shows_the_same_share():
    point = torch.tensor([9.0, 3.0, 0.0])
    larger = toy_rig.rig(1).resized(2.0, 3.0).project(point, (3 * SIZE[0], 2 * SIZE[1]))
    torch.testing.assert_close(larger.places, toy_rig.rig(1).project(point, SIZE).places)


def test_an_augmented_rig_sees_moved_points_where_it_saw_them_before():
    matrix = torch.from_numpy(BevAugmentation(0.3, 1.1, flip_x=True).matrix).float()
    points = torch.tensor([[9.0, 3.0, 0.5], [6.0, -2.0, 1.0]])
    moved = toy_rig.rig(1).augmented(matrix[None]).project(points @ matrix.T, SIZE)
    torch.testing.assert_close(moved.places, toy_rig.rig(1).project(points, SIZE).places)


def test_cells_and_shares_ascend_to_the_front_and_to_the_left():
    row, column = LEFT_AHEAD
    pillar = GRID.pillars(ROAD)[row, column, 0]
    assert pillar.tolist() == [9.0, 3.0, 0.0]
    assert (GRID.shares_from_metres(pillar[:2]) > 0.5).all()
    torch.testing.assert_close(GRID.metres_from_shares(GRID.centres()[row, column]), pillar[:2])


def test_a_cell_is_lifted_from_the_pixel_that_shows_it():
    level = torch.zeros(1, 2, 1, *SIZE)
    column, row = (int(place) for place in PIXEL_OF_LEFT_AHEAD)
    level[0, 0, 0, row, column] = 1
    lifted = BilinearLift(LiftSettings(ROAD), GRID, (1, 4)).lift(level, toy_rig.rig(1), SIZE)[0, 0]
    assert lifted.nonzero().tolist() == [list(LEFT_AHEAD)]


def test_a_cell_seen_by_two_cameras_gets_their_mean():
    rig = toy_rig.rig(1)
    twice = CameraRig(rig.intrinsics, rig.ego_from_camera[:, [0, 0]])
    level = torch.tensor([1.0, 3.0]).view(1, 2, 1, 1, 1).expand(-1, -1, -1, *SIZE)
    lifted = BilinearLift(LiftSettings(ROAD), GRID, (1, 4)).lift(level, twice, SIZE)[0, 0]
    assert lifted[LEFT_AHEAD] == 2.0
    assert lifted[LEFT_AHEAD[0], 1] == 0.0  # behind


@pytest.mark.parametrize(("sampling", "reach"), [("learned", 1), ("kernel", 2)])
def test_attention_looks_at_the_pixels_that_show_a_cell(sampling, reach):
    settings = BevFormerSettings(ROAD, heads=1, points=1, self_heads=2, feedforward=8, sampling=sampling)
    level = torch.rand(1, 2, 8, *SIZE, requires_grad=True)
    bev = bev_former(settings)([level], toy_rig.rig(1), SIZE)
    bev[0, :, *LEFT_AHEAD].square().sum().backward()
    assert level.grad is not None
    camera, rows, columns = level.grad.abs().sum(2)[0].nonzero(as_tuple=True)
    assert not camera.any()
    column, row = PIXEL_OF_LEFT_AHEAD
    assert (columns + 0.5 - column).abs().max() <= reach + 0.5
    assert (rows + 0.5 - row).abs().max() <= 1.5


@pytest.mark.parametrize("sampling", ["learned", "kernel"])
def test_a_batch_of_rigs_is_seen_like_each_alone(sampling):
    """Cameras see different numbers of cells, which are padded to the greatest."""
    settings = BevFormerSettings((0.0, 1.0), heads=2, points=2, self_heads=2, feedforward=8, sampling=sampling)
    module, rig = bev_former(settings), toy_rig.rig(2)
    turned = BevAugmentation(0.7).matrix
    rig = rig.augmented(torch.from_numpy(np.stack([np.eye(3), turned])).float())
    level = torch.rand(2, 2, 8, 8, 16)
    together = module([level], rig, SIZE)
    for sample in range(2):
        own = CameraRig(rig.intrinsics[sample : sample + 1], rig.ego_from_camera[sample : sample + 1])
        torch.testing.assert_close(together[sample], module([level[sample : sample + 1]], own, SIZE)[0])


def test_a_cell_that_two_cameras_see_alike_looks_as_through_one():
    settings = BevFormerSettings(ROAD, heads=2, points=2, self_heads=2, feedforward=8)
    module, rig, level = bev_former(settings), toy_rig.rig(1), torch.rand(1, 1, 8, 8, 16)
    torch.nn.init.zeros_(module.camera_embedding)
    once, twice = (CameraRig(rig.intrinsics[:, :count], rig.ego_from_camera[:, [0] * count]) for count in (1, 2))
    both = module([level.expand(-1, 2, -1, -1, -1)], twice, SIZE)
    module.camera_embedding = torch.nn.Parameter(module.camera_embedding[:1].detach())
    torch.testing.assert_close(both, module([level], once, SIZE))


@pytest.mark.parametrize("offset", [(0, 0), (1, 0), (0, 1), (2, -1)])
def test_attention_finds_the_cell_at_its_offset(offset):
    """The first number counts columns, to the front; the second rows, to the left."""
    attention = DeformableAttention(AttentionSettings(4, heads=1, points=1))
    for layer in (attention.value, attention.output):
        torch.nn.init.eye_(layer.weight)
    with torch.no_grad():
        attention.offsets.bias.copy_(torch.tensor(offset))
    memory, shape = torch.rand(1, GRID.rows * GRID.columns, 4), (GRID.rows, GRID.columns)
    found = attention(memory, GRID.centres().view(1, -1, 1, 2), memory, [shape])
    row, column = LEFT_AHEAD[0], LEFT_AHEAD[1] - 2
    expected = memory.view(*shape, 4)[row + offset[1], column + offset[0]]
    torch.testing.assert_close(found.view(*shape, 4)[row, column], expected)


def test_kernels_need_a_height_for_each_head():
    with pytest.raises(SettingsError, match="8 heads and 4 heights"):
        BevFormerSettings(sampling="kernel")


def test_points_must_be_shared_evenly():
    with pytest.raises(SettingsError, match="6 points cannot be shared by 4 heights"):
        replace(BevFormerSettings(), points=6)


def test_the_priors_voxels_cover_the_grid():
    grid = BevGrid().prior_grid
    assert (grid.low_m, grid.high_m, grid.shape) == ((-50, -25, -3), (50, 25, 5), (200, 100, 16))
