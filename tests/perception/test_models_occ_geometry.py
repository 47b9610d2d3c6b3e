"""Where occupancy models put what cameras see: no axis mirrored, earlier frames moved the right way."""

import math

import numpy as np
import pytest
import torch

from presight_perception.bev_pooling import PoolingGrid, bev_pool
from presight_perception.models.fb_projection import BackwardProjection, BackwardSettings, Views, ray_ends
from presight_perception.models.lift_splat import DepthBins, LiftSettings, LiftSplat, frustum
from presight_perception.models.occ_blocks import LevelMixHead, SubvoxelHead
from presight_perception.models.occ_frames import aligned, centres
from presight_perception.voxelise import VoxelGrid
from tests.perception import toy_rig

GRID = VoxelGrid((-8.0, -8.0, -1.0), (8.0, 8.0, 3.0), (1.0, 1.0, 1.0))

FINE = DepthBins(1.0, 12.0, 0.25)
FEATURES = (16, 32)  # of images of 32 x 64 pixels


def voxel_of(points_ego: tuple[float, float, float]) -> tuple[int, int, int]:
    """z, y, x of the voxel that a point lies in."""
    x, y, z = np.floor((np.array(points_ego) - GRID.low_m) / GRID.voxel_m).astype(int)
    return int(z), int(y), int(x)


def lifted(row: int, column: int, bin_: int, camera: int = 0) -> list[tuple[int, int, int]]:
    """Which voxels get the feature of one pixel at one depth."""
    points = frustum(toy_rig.rig(1), toy_rig.SIZE, FEATURES, FINE)
    depth, features = torch.zeros(1, 2, FINE.count, *FEATURES), torch.zeros(1, 2, 1, *FEATURES)
    depth[0, camera, bin_, row, column] = features[0, camera, 0, row, column] = 1.0
    pooled = bev_pool(points, depth, features, PoolingGrid(GRID.low_m, GRID.voxel_m, GRID.shape))
    return [tuple(place) for place in pooled[0, 0].nonzero().tolist()]


@pytest.mark.parametrize("point_ego", [(5.5, 2.5, 1.5), (7.5, -3.5, 0.5), (6.5, 0.5, 2.5), (-4.5, 3.5, 1.5)])
def test_a_voxel_gets_the_feature_of_the_pixel_that_it_projects_to(point_ego):
    rig, camera = toy_rig.rig(1), 0 if point_ego[0] > 0 else 1
    (u, v) = rig.project(torch.tensor(point_ego), toy_rig.SIZE).places[0, camera].tolist()
    bin_ = math.floor((abs(point_ego[0]) - FINE.low_m) / FINE.step_m)  # the cameras look along x
    assert lifted(int(v * FEATURES[0]), int(u * FEATURES[1]), bin_, camera) == [voxel_of(point_ego)]


def test_left_in_the_front_image_is_left_of_the_vehicle_and_above_is_above():
    (z, y, x), *_ = lifted(row=5, column=4, bin_=20)
    assert y > GRID.shape[1] / 2  # left: y > 0
    assert x > GRID.shape[0] / 2  # in front: x > 0
    assert GRID.low_m[2] + z * GRID.voxel_m[2] >= 1.5  # above the camera


def test_lifted_points_project_back_to_the_centres_of_their_pixels():
    points = frustum(toy_rig.rig(1), toy_rig.SIZE, FEATURES, FINE)
    places = toy_rig.rig(1).project(points[0, 0, 7], toy_rig.SIZE).places[0, 0]
    v, u = torch.meshgrid((torch.arange(16) + 0.5) / 16, (torch.arange(32) + 0.5) / 32, indexing="ij")
    torch.testing.assert_close(places, torch.stack([u, v], -1))


def test_a_mirrored_rig_sees_a_mirrored_world():
    torch.manual_seed(0)
    lift = LiftSplat(LiftSettings(4, 8, 3, FINE, camera_aware=False), GRID)
    features, rig = torch.randn(1, 2, 4, *FEATURES), toy_rig.rig(1)
    mirror = torch.diag(torch.tensor([1.0, -1.0, 1.0]))[None]
    plain = lift(features, rig, toy_rig.SIZE)[0][..., 1:-1, :]  # without the edges: see `bev_pool`
    mirrored = lift(features, rig.augmented(mirror), toy_rig.SIZE)[0][..., 1:-1, :]
    assert plain.abs().max() > 0
    torch.testing.assert_close(mirrored, plain.flip(3), atol=1e-5, rtol=1e-4)


def a_feature_at(point_ego: tuple[float, float, float]) -> torch.Tensor:
    voxels = torch.zeros(1, 1, *reversed(GRID.shape))
    voxels[0, 0][voxel_of(point_ego)] = 1.0
    return voxels


def transform(turn: float, shift: tuple[float, float, float]) -> torch.Tensor:
    found = torch.eye(4)[None].clone()
    found[0, :2, :2] = torch.tensor([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    found[0, :3, 3] = torch.tensor(shift)
    return found


def test_what_was_ahead_is_nearer_after_driving_towards_it():
    past_from_now = transform(0.0, (2.0, 0.0, 0.0))  # the vehicle drove 2 m
    found = aligned(a_feature_at((5.5, 1.5, 0.5)), past_from_now, GRID)
    torch.testing.assert_close(found, a_feature_at((3.5, 1.5, 0.5)))


def test_what_was_ahead_is_on_the_right_after_turning_left():
    past_from_now = transform(math.pi / 2, (0.0, 0.0, 0.0))  # the vehicle's axes turned left by 90 degrees
    found = aligned(a_feature_at((5.5, 0.5, 0.5)), past_from_now, GRID)
    torch.testing.assert_close(found, a_feature_at((0.5, -5.5, 0.5)), atol=1e-5, rtol=0)


def test_nothing_is_known_beyond_the_earlier_grid():
    found = aligned(torch.ones(1, 1, 4, 16, 16), transform(0.0, (3.0, 0.0, 0.0)), GRID)
    assert found[0, 0, 0, 0].tolist() == [1.0] * 13 + [0.0] * 3


def test_lifting_into_the_present_grid_equals_aligning_afterwards():
    torch.manual_seed(0)
    lift = LiftSplat(LiftSettings(4, 8, 3, FINE, camera_aware=False), GRID)
    features, past_from_now = torch.randn(1, 2, 4, *FEATURES), transform(0.0, (2.0, -1.0, 0.0))
    now = lift(features, toy_rig.rig(1), toy_rig.SIZE, past_from_now.inverse())[0]
    then = lift(features, toy_rig.rig(1), toy_rig.SIZE)[0]
    inside = aligned(torch.ones(1, 1, 4, 16, 16), past_from_now, GRID)
    inside[..., :1], inside[..., -1:, :] = 0, 0  # the lower faces take in what lies just below: see `bev_pool`
    assert (now * inside).abs().max() > 0
    torch.testing.assert_close(now * inside, aligned(then, past_from_now, GRID) * inside, atol=1e-4, rtol=1e-4)


def test_centres_are_where_points_fall_into_their_voxels():
    points = centres(GRID, torch.zeros(1))
    assert voxel_of(tuple(points[2, 5, 11].tolist())) == (2, 5, 11)


def backward() -> BackwardProjection:
    """One that looks exactly where cells project to."""
    torch.manual_seed(0)
    module = BackwardProjection(BackwardSettings(8, 2, 4, 4, 2, 16), GRID, FINE).eval()
    torch.nn.init.zeros_(module.cross_attention.offsets.bias)
    return module


def seen_pixels(cell: tuple[int, int], depth: torch.Tensor) -> list[set[tuple[int, int]]]:
    """Feature pixels (row, column) of each camera on which what a cell (row, column) finds depends."""
    context = torch.randn(1, 2, 8, *FEATURES, requires_grad=True)
    module = backward()
    query = torch.randn(1, GRID.shape[0] * GRID.shape[1], 8)
    found = module._look_back(query, Views(context, depth, toy_rig.rig(1), toy_rig.SIZE))
    found.view(GRID.shape[1], GRID.shape[0], 8)[cell].sum().backward()
    return [{tuple(place) for place in camera.abs().sum(0).nonzero().tolist()} for camera in context.grad[0]]


def test_a_cell_looks_where_its_pillar_projects_to():
    even = torch.full((1, 2, FINE.count, *FEATURES), 1 / FINE.count)
    x, y = 6.5, 2.5
    front, rear = seen_pixels((10, 14), even)
    expected = set()
    for z in (-0.5, 0.5, 1.5, 2.5):
        u, v = toy_rig.rig(1).project(torch.tensor((x, y, z)), toy_rig.SIZE).places[0, 0].tolist()
        column, row = u * FEATURES[1] - 0.5, v * FEATURES[0] - 0.5
        expected |= {(math.floor(row) + i, math.floor(column) + j) for i in (0, 1) for j in (0, 1)}
    assert rear == set()
    assert front and front <= expected


def test_a_cell_finds_nothing_where_rays_end_elsewhere():
    depth = torch.zeros(1, 2, FINE.count, *FEATURES)
    depth[:, :, 3] = 1.0  # all rays end within 2 m
    assert seen_pixels((10, 14), depth) == [set(), set()]


def test_the_chance_of_a_ray_is_read_at_its_place_and_bin():
    depth = torch.rand(1, 4, 3, 5)
    place = torch.tensor([[[[3.5 / 5, 1.5 / 3]]]])  # the centre of column 3, row 1
    bins = DepthBins(1.0, 5.0, 1.0)
    for metres, bin_ in ((1.2, 0), (3.0, 2), (99.0, 3), (0.2, 0)):
        chance = ray_ends(depth, place, torch.tensor([[[metres]]]), bins)
        torch.testing.assert_close(chance[0, 0, 0], depth[0, bin_, 1, 3])


def test_subvoxels_lie_in_their_voxel():
    torch.manual_seed(0)
    head, voxels = SubvoxelHead(2, 3, 2), torch.zeros(1, 2, 4, 5, 6)
    changed = voxels.clone()
    changed[0, :, 0, 2, 4] = 5.0  # z, y, x: its neighbours change too, for the convolution
    change = (head(changed) - head(voxels))[0].detach().abs().sum(-1)
    assert change.shape == (12, 10, 8)
    assert change[6:, 2:8, :4].amin() > 0
    assert change.sum() == pytest.approx(change[6:, 2:8, :4].sum().item())


def test_each_subvoxel_has_its_own_weights():
    torch.manual_seed(0)
    head = SubvoxelHead(2, 3, 2)
    with torch.no_grad():
        last = head.classes[2]
        last.weight.zero_()
        last.bias.copy_(torch.arange(24.0))  # x, then y, then z, then class
    found = head(torch.zeros(1, 2, 1, 1, 1))[0, :, :, :, 0]
    assert found.flatten().tolist() == [0, 3, 6, 9, 12, 15, 18, 21]


def test_the_doubled_head_keeps_places():
    torch.manual_seed(0)
    head, voxels = LevelMixHead(8, 1, (4, 2), 3).eval(), torch.zeros(1, 8, 4, 5, 6)
    changed = voxels.clone()
    changed[0, :, 3, 0, 5] = 5.0  # the top of the front right corner
    change = (head([changed]) - head([voxels]))[0].abs().sum(0)
    assert change.shape == (8, 10, 12)
    assert change[6:, :2, 10:].amin() > 0
    assert change[:2].sum() == change[:, 6:].sum() == change[:, :, :6].sum() == 0
