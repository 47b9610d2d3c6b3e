"""Neural Map Prior: what one drive writes, another reads at the right place; its fusion; the model that has it."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from presight_core import frames
from presight_core.errors import InputError, SettingsError
from presight_perception.models.bev_features import Sources
from presight_perception.models.bev_grid import BevGrid
from presight_perception.models.nmp_raster_mapper import NmpRasterMapper
from presight_perception.models.raster_mapper import RasterMapperSettings
from presight_perception.neural_map_prior import BLOCK_CELLS, MapPriorFusion, NeuralMap, NeuralMapSettings
from tests.perception import toy_rig

README = Path(__file__).resolve().parents[2] / "perception" / "README.md"
GRID = BevGrid(60.0, 30.0, 30, 60)  # cells of 1 m; row 15 begins at the vehicle, so does column 30
SETTINGS = NeuralMapSettings(GRID, channels=2, cell_m=0.25, heads=1)
EASTWARD = frames.planar_transform(100.0, 50.0, 0.0)
TOY = NeuralMapSettings(toy_rig.GRID, channels=4, window=(3, 4), heads=2)


def features(settings: NeuralMapSettings, batch: int = 1, seed: int = 0) -> torch.Tensor:
    shape = (batch, settings.channels, settings.grid.rows, settings.grid.columns)
    return (torch.rand(shape, generator=torch.Generator().manual_seed(seed)) + 0.5).half().float()


def landmark(row: int, column: int) -> torch.Tensor:
    bev = torch.zeros(2, GRID.rows, GRID.columns)
    bev[1, row, column] = 1.0
    return bev


def hits(bev: torch.Tensor) -> list[list[int]]:
    return bev[1].nonzero().tolist()


def tiny(seed: int = 0) -> NmpRasterMapper:
    torch.manual_seed(seed)
    settings = RasterMapperSettings.tiny(Sources(), toy_rig.GRID)
    return NmpRasterMapper(settings, NeuralMapSettings(window=(3, 4), heads=2))


@pytest.mark.parametrize(
    ("pose", "row", "column"),
    [
        (frames.planar_transform(105.0, 50.0, 0.0), 18, 35),  # 5 m closer: 5.5 m in front, 3.5 m to the left
        (frames.planar_transform(100.0, 52.0, 0.0), 16, 40),  # from the left lane
        (frames.planar_transform(112.0, 43.0, np.pi / 2), 16, 40),  # northward: 10.5 m in front, 1.5 m to the left
        (frames.planar_transform(100.0, 50.0, np.pi), 11, 19),  # turned back: behind, on the right
    ],
)
def test_a_landmark_is_read_where_it_is_from_another_pose(pose, row, column):
    """It stands 10.5 m east and 3.5 m north of the vehicle that wrote it."""
    neural_map = NeuralMap(SETTINGS)
    neural_map.write("town", EASTWARD, landmark(row=18, column=40))
    assert hits(neural_map.read("town", pose)) == [[row, column]]


@pytest.mark.parametrize("yaw_rad", [0.0, 0.4, 2.0, -1.3])
def test_what_is_written_is_read_back(yaw_rad):
    neural_map = NeuralMap(SETTINGS)
    pose, bev = frames.planar_transform(-7.3, 12.1, yaw_rad), features(SETTINGS)[0]
    neural_map.write("town", pose, bev)
    torch.testing.assert_close(neural_map.read("town", pose), bev, rtol=0, atol=0)


def test_a_turned_vehicle_reads_every_cell_without_holes():
    neural_map = NeuralMap(SETTINGS)
    neural_map.write("town", EASTWARD, torch.ones(2, GRID.rows, GRID.columns))
    found = neural_map.read("town", EASTWARD @ frames.planar_transform(0.0, 0.0, 0.8))
    metres = GRID.pillars((0.0,))[:, :, 0]
    x, y = (metres.numpy() @ frames.planar_transform(0.0, 0.0, 0.8)[:2, :3].T).transpose(2, 0, 1)
    within = torch.from_numpy((abs(x) < 29.5) & (abs(y) < 14.5))
    outside = torch.from_numpy((abs(x) > 30.5) | (abs(y) > 15.5))
    assert within.sum() > 500
    assert (found[:, within] == 1).all()
    assert (found[:, outside] == 0).all()


def test_a_mirrored_frame_reads_mirrored_features():
    neural_map = NeuralMap(SETTINGS)
    bev = features(SETTINGS)[0]
    neural_map.write("town", EASTWARD, bev)
    mirrored = neural_map.read("town", EASTWARD @ np.diag([1.0, -1.0, 1.0, 1.0]))
    torch.testing.assert_close(mirrored, bev.flip(1), rtol=0, atol=0)


def test_a_later_drive_replaces_what_it_sees_and_no_more():
    neural_map = NeuralMap(SETTINGS)
    neural_map.write("town", EASTWARD, torch.ones(2, GRID.rows, GRID.columns))
    neural_map.write("town", frames.planar_transform(120.0, 50.0, 0.0), torch.full((2, GRID.rows, GRID.columns), 3.0))
    found = neural_map.read("town", EASTWARD)
    assert (found[:, :, :20] == 1).all()
    assert (found[:, :, 20:] == 3).all()


def test_cities_do_not_mix_and_are_forgotten_when_cleared():
    neural_map = NeuralMap(SETTINGS)
    neural_map.write("town", EASTWARD, torch.ones(2, GRID.rows, GRID.columns))
    assert not neural_map.read("village", EASTWARD).any()
    neural_map.clear()
    assert not neural_map.read("town", EASTWARD).any()
    assert neural_map.size_bytes == 0


def test_memory_follows_the_driven_area():
    """Far apart, two drives take twice the memory of one: nothing for what lies between."""
    neural_map = NeuralMap(SETTINGS)
    sizes = []
    for x_m in (0.0, 0.0, 16_000.0):
        neural_map.write("town", frames.planar_transform(x_m, 0.0, 0.0), features(SETTINGS)[0])
        sizes.append(neural_map.size_bytes)
    block_m, block_bytes = BLOCK_CELLS * SETTINGS.cell_m, BLOCK_CELLS**2 * SETTINGS.channels * 2
    assert sizes[0] == sizes[1] == (2 * np.ceil(30 / block_m)) * (2 * np.ceil(15 / block_m)) * block_bytes
    assert sizes[2] == 2 * sizes[0]


def test_features_of_another_shape_are_an_error():
    with pytest.raises(InputError, match=r"\(1, 2, 30, 60\) for a map of \(2, 30, 60\)"):
        NeuralMap(SETTINGS).write("town", EASTWARD, features(SETTINGS))


def test_windows_that_do_not_fit_the_grid_are_an_error():
    with pytest.raises(SettingsError, match=r"30 x 60 cells cannot be cut into windows of \(7, 20\)"):
        MapPriorFusion(replace(SETTINGS, window=(7, 20)))


def test_a_cell_is_fused_with_the_prior_of_its_own_window():
    """Attention reaches the window's edge; three convolutions, one after the other, a cell farther each."""
    torch.manual_seed(0)
    fusion = MapPriorFusion(TOY).eval()
    bev, prior = features(TOY), features(TOY, seed=1)
    changed = prior.clone()
    changed[0, :, 4, 5] += 1.0  # in the second row of windows, rows 3 to 5, and their second column, 4 to 7
    with torch.no_grad():
        moved = (fusion(bev, changed) != fusion(bev, prior)).any(1)[0].nonzero()
    assert moved.amin(0).tolist() == [0, 1]
    assert moved.amax(0).tolist() == [5, 10]


def test_cells_without_prior_are_not_looked_at():
    torch.manual_seed(0)
    fusion = MapPriorFusion(TOY).eval()
    bev, empty = features(TOY), torch.zeros_like(features(TOY))
    with torch.no_grad():
        before = fusion(bev, empty)
        torch.nn.init.normal_(fusion.prior_position)  # is added to what is looked at
        torch.testing.assert_close(fusion(bev, empty), before)
        assert torch.isfinite(before).all()
        assert not torch.allclose(fusion(bev, features(TOY)), before)


def test_windows_are_put_back_where_they_were_cut():
    fusion = MapPriorFusion(TOY)
    bev = features(TOY, batch=3)
    torch.testing.assert_close(fusion._grid(fusion._windows(bev)), bev, rtol=0, atol=0)
    torch.testing.assert_close(fusion._windows(bev)[1], bev[0, :, :3, 4:8].flatten(1).T, rtol=0, atol=0)


def test_a_gate_that_trusts_the_prior_keeps_it():
    """With the balance at the prior's side and the recurrent unit at rest, the map is the answer."""
    fusion = MapPriorFusion(TOY).eval()
    prior = features(TOY)
    for convolution in (fusion.balance, fusion.update):
        torch.nn.init.zeros_(convolution.weight)
        with torch.no_grad():  # the prior's own channels, all positive, push the gates' answers far below zero
            convolution.weight[:, : TOY.channels, 1, 1] = -100.0
    with torch.no_grad():
        torch.testing.assert_close(fusion(features(TOY, seed=2), prior), prior)


def test_the_map_changes_predictions_and_its_absence_is_an_empty_map():
    model = tiny().eval()
    given = (toy_rig.pictures(), toy_rig.rig())
    prior = features(model.prior_settings, batch=2)
    with torch.no_grad():
        without = model(*given)
        torch.testing.assert_close(model(*given, torch.zeros_like(prior)), without)
        torch.testing.assert_close(model(*given, prior), model.predict(model.fused(*given, prior)))
        assert not torch.allclose(model(*given, prior), without)


def test_every_weight_learns_from_two_passes_over_a_place():
    model = tiny()
    neural_map = NeuralMap(model.prior_settings)
    truths = [model.truth_of(toy_rig.lines(side)) for side in (1.0, -1.0)]
    poses = [frames.planar_transform(50.0 * number, 0.0, 0.3) for number in range(2)]
    for _ in range(2):
        prior = torch.stack([neural_map.read("town", pose) for pose in poses])
        fused = model.fused(toy_rig.pictures(), toy_rig.rig(), prior)
        torch.stack(list(model.loss(model.predict(fused), truths).values())).sum().backward()
        for pose, bev in zip(poses, fused, strict=True):
            neural_map.write("town", pose, bev)
    idle = [name for name, weight in model.named_parameters() if weight.grad is None or not weight.grad.any()]
    assert idle == []


def test_the_readmes_example_fills_the_map():
    (code,) = [
        block for block in re.findall(r"```py\n(.*?)```", README.read_text(), re.DOTALL) if "NeuralMap(" in block
    ]
    truths = torch.zeros(2, 3, 60, 120)
    poses = torch.from_numpy(np.stack([EASTWARD, EASTWARD]))
    names = {"NmpRasterMapper": NmpRasterMapper, "NeuralMap": NeuralMap, "settings": RasterMapperSettings.tiny()}
    names |= {"torch": torch, "batches": [(toy_rig.pictures(), toy_rig.rig(), "town", poses, truths)]}
    exec(code, names)
    torch.testing.assert_close(names["neural_map"].read("town", EASTWARD), names["fused"][1], atol=1e-3, rtol=0)


def test_voxels_are_not_this_models_prior():
    with pytest.raises(InputError, match="not voxels; give a tensor"):
        tiny()(toy_rig.pictures(), toy_rig.rig(), toy_rig.prior())
    with pytest.raises(SettingsError, match="has no voxels"):
        NmpRasterMapper(RasterMapperSettings.tiny(Sources(prior_channels=4), toy_rig.GRID))
