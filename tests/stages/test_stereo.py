"""Depths of images from their neighbours, on a street with a wall across its end."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from presight_core import classes
from presight_core.drives import FrameTable
from presight_core.errors import InputError
from presight_core.field.rays import Rays
from presight_core.pixels import FramePixels, PixelSource
from presight_core.plane_sweep import CELL_PX
from presight_core.progress import Progress
from stages import stereo
from stages.card_training import CardRun
from stages.feeding import Feed
from stages.ray_pool import RayPool
from stages.stereo import Images, KnownDepths, plane_maps, small_cameras
from stages.training import Run, known_depths, train_tile, training_rows
from tests.patterned_scene import GROUND, HEIGHT, INTRINSICS, WIDTH, camera_at, depth_m, picture, wall
from tests.stages.small_training import street, tiny_job

PLANES = GROUND, wall(14.0)
PLACES = [(0.5 * i, y_m) for i in range(5) for y_m in (-0.8, 0.0, 0.8)]
CAR = classes.CITYSCAPES.index("car")
BUILDING = classes.CITYSCAPES.index("building")


class Street(PixelSource):
    """Its pictures. The wall's left part is a car, so far as labels can tell."""

    def __init__(self, frames: FrameTable) -> None:
        self._frames = frames

    def load(self, row: int) -> FramePixels:
        camera = self._frames.camera_of(row)
        grey, is_wall = picture(camera, *PLANES), depth_m(camera, *PLANES) < depth_m(camera, GROUND) - 0.01
        labels = np.where(is_wall, BUILDING, 0).astype(np.uint8)
        labels[:, : WIDTH // 4] = np.where(is_wall[:, : WIDTH // 4], CAR, 0)
        return FramePixels(np.stack([grey] * 3, -1), labels, np.zeros((4, 6, 3), np.uint8))


def drives(count: int = 1) -> FrameTable:
    """Fifteen pictures of the street."""
    frames = street(len(PLACES), count)
    poses = np.stack([camera_at(*place).world_from_camera for place in PLACES])
    size = {"width_px": np.full(len(PLACES), WIDTH, np.int32), "height_px": np.full(len(PLACES), HEIGHT, np.int32)}
    intrinsics = np.tile(INTRINSICS, (len(PLACES), 1, 1))
    return replace(frames, world_from_camera=poses, intrinsics=intrinsics, **size)


def images_of(frames: FrameTable) -> Images:
    return Images(frames, np.arange(len(frames)), Street(frames))


def depths_m(maps: np.ndarray) -> np.ndarray:
    """In the middle of each cell; 0: unknown."""
    nearness = maps[..., 0].astype(np.float64)
    return np.divide(1, nearness, out=np.zeros_like(nearness), where=nearness > 0)


def truth_of(frames: FrameTable, row: int) -> np.ndarray:
    return depth_m(frames.camera_of(row), *PLANES)[CELL_PX // 2 :: CELL_PX, CELL_PX // 2 :: CELL_PX]


def labels_of(frames: FrameTable, row: int) -> np.ndarray:
    return Street(frames).load(row).labels[CELL_PX // 2 :: CELL_PX, CELL_PX // 2 :: CELL_PX]


def test_depths_are_right_and_missing_only_where_they_cannot_be_told(tmp_path):
    frames = drives()
    found_m = depths_m(plane_maps(images_of(frames), WIDTH, tmp_path / "depths.npy"))
    truth = np.stack([truth_of(frames, row) for row in range(len(frames))])
    known = found_m > 0
    assert known.mean() > 0.3
    assert (np.abs(found_m / truth - 1)[known] < 0.05).mean() > 0.95
    assert (np.abs(found_m / truth - 1)[known & (truth > 11)] < 0.05).mean() > 0.9


def test_of_moving_things_nothing_is_said(tmp_path):
    frames = drives()
    maps = plane_maps(images_of(frames), WIDTH, tmp_path / "depths.npy")
    labels = np.stack([labels_of(frames, row) for row in range(len(frames))])
    assert (maps[labels == CAR] == 0).all()
    assert (maps[labels == BUILDING] > 0).any()


def test_an_image_that_shows_something_else_has_no_depths(tmp_path, monkeypatch):
    frames, strange = drives(), 7
    honest = Street.load

    def load(self: Street, row: int) -> FramePixels:
        pixels = honest(self, row)
        noise = np.random.default_rng(row).integers(0, 255, pixels.rgb.shape, np.uint8)
        return replace(pixels, rgb=noise) if row == strange else pixels

    monkeypatch.setattr(Street, "load", load)
    maps = plane_maps(images_of(frames), WIDTH, tmp_path / "depths.npy")
    shares = (maps[..., 0] > 0).mean((1, 2))
    assert shares[strange] < 0.05  # a guess in 25 agrees by chance
    assert np.delete(shares, strange).mean() > 0.25


def test_drives_are_compared_within_themselves_and_judged_by_all(tmp_path):
    one, three = drives(1), drives(3)  # five pictures a drive
    shares = [
        (plane_maps(images_of(each), WIDTH, tmp_path / f"{each.drive_id[-1]}.npy")[..., 0] > 0).mean()
        for each in (one, three)
    ]
    assert shares[1] > shares[0] / 3
    lone = replace(one, drive_id=np.array([f"drive{i}" for i in range(len(one))]))
    assert not plane_maps(images_of(lone), WIDTH, tmp_path / "lone.npy").any()


def test_maps_are_made_once(tmp_path):
    images, seen = images_of(drives()), []
    first = plane_maps(images, WIDTH, tmp_path / "depths.npy", seen.append)
    assert seen[-1] == Progress("stereo", len(PLACES), len(PLACES))
    assert [file.name for file in tmp_path.iterdir()] == ["depths.npy"]
    again = plane_maps(images, WIDTH, tmp_path / "depths.npy", seen.append)
    assert len(seen) == len(PLACES)
    np.testing.assert_array_equal(first, again)


def test_an_unreadable_image_stops_it_and_leaves_nothing_half_done(tmp_path, monkeypatch):
    def load(self: Street, row: int) -> FramePixels:
        raise InputError("3.jpg: cannot be read; restore the file")

    monkeypatch.setattr(Street, "load", load)
    with pytest.raises(InputError, match=r"3\.jpg"):
        plane_maps(images_of(drives()), WIDTH, tmp_path / "depths.npy")
    assert not (tmp_path / "depths.npy").exists()


def test_images_of_other_sizes_share_one_array(tmp_path):
    frames = drives()
    heights = frames.height_px.copy()
    heights[::3] = HEIGHT // 2

    class Cropped(Street):
        def load(self, row: int) -> FramePixels:
            pixels, height = super().load(row), heights[row]
            return replace(pixels, rgb=pixels.rgb[:height], labels=pixels.labels[:height])

    cropped = replace(frames, height_px=heights)
    maps = plane_maps(Images(cropped, np.arange(len(frames)), Cropped(frames)), WIDTH, tmp_path / "depths.npy")
    assert maps.shape[1:3] == (HEIGHT // CELL_PX, WIDTH // CELL_PX)
    assert not maps[::3, HEIGHT // CELL_PX // 2 :].any()
    assert maps[1::3].any()


def test_rays_of_images_end_at_their_known_depths(tmp_path):
    frames = drives()
    maps = plane_maps(images_of(frames), WIDTH, tmp_path / "depths.npy")
    pool = RayPool(frames, Street(frames), np.arange(len(frames)))
    random = np.random.default_rng(0)
    images, pixels = random.integers(len(frames), size=500), random.integers((WIDTH, HEIGHT), size=(500, 2))
    batch = pool.at(images, pixels)
    values = (torch.from_numpy(value.astype(np.float32)) for value in (batch.origins_world, batch.directions_world))
    rays, labels = Rays(*values, None, torch.from_numpy(images)), torch.zeros(500, dtype=torch.uint8)
    found_m = KnownDepths(maps, frames, WIDTH, "cpu").along(rays, labels)[:, 0].numpy()
    cells = images, pixels[:, 1] // CELL_PX, pixels[:, 0] // CELL_PX
    np.testing.assert_array_equal(found_m > 0, maps[cells][:, 0] > 0)
    true_m = np.stack([depth_m(frames.camera_of(row), *PLANES) for row in range(len(frames))])
    met = batch.origins_world + found_m[:, None] * batch.directions_world
    forward_m = (met - batch.origins_world)[:, 0]  # all cameras look along x
    error = np.abs(forward_m / true_m[images, pixels[:, 1], pixels[:, 0]] - 1)[found_m > 0]
    assert (error < 0.03).mean() > 0.9


def test_depths_follow_the_ground_from_pixel_to_pixel(tmp_path):
    frames = drives()
    depths = KnownDepths(plane_maps(images_of(frames), WIDTH, tmp_path / "depths.npy"), frames, WIDTH, "cpu")
    camera, true_m = frames.camera_of(7), depth_m(frames.camera_of(7), GROUND)
    rows = np.flatnonzero((true_m[:, 0] > 7) & (true_m[:, 0] < 11))
    _, directions = camera.rays(np.stack([np.full(len(rows), WIDTH / 2), rows + 0.5], -1))
    towards = torch.from_numpy(directions).float()
    rays = Rays(torch.zeros(len(rows), 3), towards, None, torch.full((len(rows),), 7))
    found_m = depths.along(rays, torch.zeros(len(rows), dtype=torch.uint8))[:, 0] * towards[:, 0]
    assert len(np.unique(found_m)) == len(rows) > CELL_PX
    np.testing.assert_allclose(found_m, true_m[rows, WIDTH // 2], rtol=0.02)


def test_slim_things_end_at_the_nearest_of_the_depths_around_them():
    frames = drives()
    maps = np.zeros((len(frames), HEIGHT // CELL_PX, WIDTH // CELL_PX, 3), np.float16)
    maps[..., 0] = 1 / 16
    maps[0, 3, 5, 0], maps[0, 6:, 10:] = 1 / 4, 0  # a post in one cell; a corner of which nothing is known
    columns, rows = np.array([5, 6, 7, 8, 10, 11]), np.array([3, 4, 3, 4, 6, 8])
    camera = small_cameras(frames.select(np.array([0])), WIDTH)[0]
    _, directions = camera.rays(CELL_PX * (np.stack([columns, rows], -1) + 0.5))
    rays = Rays(torch.zeros(6, 3), torch.from_numpy(directions).float(), None, torch.zeros(6, dtype=torch.int64))
    along_axis = torch.from_numpy(directions @ camera.world_from_camera[:3, 2]).float()
    depths = KnownDepths(maps, frames, WIDTH, "cpu")
    own, nearest = torch.tensor([4.0, 16, 16, 16, 0, 0]), torch.tensor([4.0, 4, 16, 16, 16, 0])
    for label, ends in (("building", own), ("pole", nearest), ("traffic sign", nearest)):
        labels = torch.full((6,), classes.CITYSCAPES.index(label), dtype=torch.uint8)
        found = depths.along(rays, labels) * along_axis[:, None]
        torch.testing.assert_close(found, torch.stack([ends, nearest], -1))


def test_both_ways_to_train_heed_known_depths(tmp_path):
    frames = drives()
    job = tiny_job("training.stereo.weight=0.1", "training.stereo.width_px=96", frames=frames)
    source, rows = Street(frames), training_rows(frames, job.settings.training)
    depths = known_depths(job, source, rows, tmp_path)
    with Feed(job, source, rows) as feed:
        found = Run(job, tmp_path, depths).train(0, feed.batch(0))["stereo"]
    assert 0 < found < 0.1 * np.log(11)  # a tenth of the rays' whole weight is the worst
    on_card = CardRun(job, tmp_path, source, rows, depths=depths).advance(0)["stereo"]
    assert 0 < on_card < 0.1 * np.log(11)


def test_a_tile_trains_with_known_depths_and_goes_on_without_looking_again(tmp_path, monkeypatch):
    frames = drives()
    job = tiny_job("training.stereo.weight=0.1", "training.stereo.width_px=96", frames=frames)
    seen: list[Progress] = []
    train_tile(job, Street(frames), tmp_path, seen.append)
    assert seen[0].stage == "stereo"
    assert np.isfinite(seen[-1].figures["loss"])
    monkeypatch.setattr(stereo, "sweep", None)
    train_tile(job, Street(frames), tmp_path)


def test_without_a_weight_nothing_is_compared(tmp_path):
    job = tiny_job(frames=drives())
    assert known_depths(job, Street(drives()), np.arange(15), tmp_path) is None
    assert not list(tmp_path.iterdir())
