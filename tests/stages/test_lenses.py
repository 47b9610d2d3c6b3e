"""Images that are darker towards their corners: the field learns by how much, and that surfaces are not."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from presight_core.field.checkpoint import load_field
from presight_core.field.lens import LensFalloff, off_centre
from presight_core.pixels import FramePixels
from stages.evaluation import evaluate_tile
from stages.ray_pool import RayPool
from stages.training import lens_numbers, train_tile
from tests.stages.small_training import SIZE, Gradient, street, tiny_job

LOSS = 0.3  # of the light, in the corners
LONG = ("training.steps=200", "training.batch_rays=256", "training.warmup=0.0", "training.ground.weight=0.0")


class Vignetted(Gradient):
    """The same grey everywhere, but for the lens."""

    def load(self, row: int) -> FramePixels:
        middles = np.stack(np.meshgrid(*((np.arange(size) + 0.5) / size for size in SIZE)), -1).reshape(-1, 2)
        brightness = 200 * (1 - LOSS * off_centre(middles, np.array(SIZE))).reshape(SIZE[::-1])
        rgb = np.repeat(brightness[..., None], 3, -1).round().astype(np.uint8)
        return replace(super().load(row), rgb=rgb)


def test_the_middle_is_at_0_and_the_corners_are_at_1():
    unit, size_px = np.array([[0.5, 0.5], [0, 0], [1, 0], [0.5, 1]]), np.tile([400.0, 300.0], (4, 1))
    np.testing.assert_allclose(off_centre(unit, size_px), [0, 1, 1, 0.6**2])
    torch.testing.assert_close(off_centre(torch.from_numpy(unit), torch.from_numpy(size_px))[3].item(), 0.36)


def test_there_is_no_falloff_at_first_and_never_in_the_middle():
    lens = LensFalloff(2)
    assert torch.equal(lens(torch.tensor([0, 1]), torch.tensor([0.3, 1.0])), torch.ones(2, 1))
    with torch.no_grad():
        lens.terms.copy_(torch.tensor([[-0.2, -0.1], [-0.4, 0.0]]))
    found = lens(torch.tensor([0, 0, 1]), torch.tensor([0.0, 1.0, 0.5]))
    torch.testing.assert_close(found, torch.tensor([[1.0], [0.7], [0.8]]))


def test_cameras_of_each_drive_are_told_apart():
    frames = street(6, drives=2)
    frames = replace(frames, camera=np.array(["CAM_BACK", "CAM_FRONT"] * 3))
    assert lens_numbers(frames).tolist() == [0, 1, 0, 3, 2, 3]


def test_a_pool_tells_how_far_from_the_middle_pixels_are():
    pool = RayPool(street(), Vignetted(), np.arange(2))
    pixels = np.array([[0, 0], [SIZE[0] - 1, 0], [SIZE[0] // 2, SIZE[1] // 2]])
    found = pool.at(np.zeros(3, np.int64), pixels).off_centre
    assert found[0] == pytest.approx(found[1]) == pytest.approx(1, abs=0.11)
    assert found[2] < 0.01


def test_training_learns_the_falloff_and_evaluation_shows_it(tmp_path):
    jobs = {on: tiny_job(*LONG, f"field.lens_falloff={str(on).lower()}") for on in (True, False)}
    fields = {on: load_field(train_tile(job, Vignetted(), tmp_path / str(on)).folder) for on, job in jobs.items()}
    lenses = fields[True].lenses
    assert lenses is not None
    corner = lenses(torch.tensor([0]), torch.tensor([1.0])).item()
    assert corner == pytest.approx(1 - LOSS, abs=0.08)
    psnr_db = {
        on: evaluate_tile(job, fields[on], Vignetted(), tmp_path / "rows").metrics["psnr_db"]
        for on, job in jobs.items()
    }
    assert psnr_db[True] > psnr_db[False] + 3
