from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from presight_core import classes
from presight_core.config import GroundSettings
from presight_core.drives import FrameTable
from presight_core.errors import InputError
from presight_core.field.checkpoint import load_field
from presight_core.field.tile_field import Rays
from presight_core.frames import planar_transform
from presight_core.pixels import FramePixels, PixelSource
from presight_core.tiles import SubField
from stages import card_pool, card_training
from stages.card_ground import CardGround
from stages.card_training import CardRun
from stages.ground import SIDEWALK, Ground
from stages.ray_pool import PixelBatch, RayPool
from stages.stereo import KnownDepths
from stages.training import TileTraining, train_tile
from tests.core.without_card import interpreted
from tests.stages.small_training import tiny_settings

WIDTH, HEIGHT = 12, 8
CAR = classes.CITYSCAPES.index("car")
EGO_FROM_CAMERA = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])
SUB_FIELDS = (
    SubField((0.0, 0, 1.5), (-15, -15, -4), (15, 15, 16)),
    SubField((40.0, 0, 1.5), (25, -15, -4), (55, 15, 16)),
)


class Numbered(PixelSource):
    """Images whose colours tell the image, the column and the row; a car covers ever more columns of them."""

    def load(self, row: int) -> FramePixels:
        rgb = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        rgb[..., 0], rgb[..., 1], rgb[..., 2] = row, np.arange(WIDTH), np.arange(HEIGHT)[:, None]
        labels = np.zeros((HEIGHT // 2, WIDTH // 2), np.uint8)
        labels[0] = classes.SKY
        labels[:, : self.hidden(row)] = CAR
        features = np.full((2, 3, 3), row, np.uint8)
        features[..., 1] = np.arange(6).reshape(2, 3)
        return FramePixels(rgb, labels, features)

    @staticmethod
    def hidden(row: int) -> int:
        """Label columns, of six, that show the car."""
        return row % 3


def frames(places_m: tuple[float, ...] = (0, 1, 2, 40)) -> FrameTable:
    count = len(places_m)
    return FrameTable(
        drive_id=np.array([f"drive{i % 2}" for i in range(count)]),
        camera=np.full(count, "CAM_FRONT"),
        timestamp_us=np.arange(count) * 500_000,
        path=np.array([f"{i}.jpg" for i in range(count)]),
        file_bytes=np.ones(count, np.int64),
        width_px=np.full(count, 2 * WIDTH, np.int32),
        height_px=np.full(count, 2 * HEIGHT, np.int32),
        intrinsics=np.tile(np.array([[20.0, 0, 12], [0, 20, 8], [0, 0, 1]]), (count, 1, 1)),
        world_from_camera=np.stack([planar_transform(x, 3, 0.2 * x) @ EGO_FROM_CAMERA for x in places_m]),
        is_keyframe=np.ones(count, np.bool_),
    )


def card_run(tmp_path: Path, *overrides: str, table: FrameTable | None = None) -> CardRun:
    table = frames() if table is None else table
    settings = tiny_settings("training.holdout_every=0", *overrides)
    job = TileTraining("t000", table, SUB_FIELDS, settings, feature_channels=3)
    planes = np.tile(np.array([1 / 8, 0, 0], np.float16), (len(table), 2, 3, 1))  # everything 8 m ahead
    depths = KnownDepths(planes, table, WIDTH, "cpu")
    is_known = settings.training.stereo.weight > 0
    return CardRun(job, tmp_path, Numbered(), np.arange(len(table)), depths=depths if is_known else None)


def draws(count: int) -> torch.Tensor:
    return torch.rand(count, 2, generator=torch.Generator().manual_seed(0))


def test_rays_and_targets_are_those_of_the_pool_on_the_host(tmp_path):
    run = card_run(tmp_path)
    run.pool.show(0)
    rays, targets = run.pool.draw(draws(300))
    images, columns, rows = targets.rgb.numpy().astype(np.int64).T
    expected = RayPool(frames(), Numbered(), np.arange(4)).at(images, np.stack([columns, rows], -1))
    np.testing.assert_array_equal(targets.labels, expected.labels)
    np.testing.assert_array_equal(targets.features, expected.features)
    np.testing.assert_allclose(rays.directions, expected.directions_world, atol=1e-6)
    np.testing.assert_allclose(rays.origins.numpy() + run.field.origin_m, expected.origins_world, atol=1e-5)
    np.testing.assert_array_equal(rays.images, images)
    np.testing.assert_array_equal(rays.videos, images % 2)
    np.testing.assert_array_equal(rays.lenses, images % 2)
    np.testing.assert_allclose(rays.off_centre, expected.off_centre, atol=1e-6)


def test_dynamic_pixels_are_never_drawn_and_all_others_are(tmp_path):
    run = card_run(tmp_path)
    run.pool.show(0)
    _, targets = run.pool.draw(draws(20_000))
    assert not (targets.labels == CAR).any()
    static = sum(HEIGHT * (WIDTH - 2 * Numbered.hidden(row)) for row in range(4))
    assert len(torch.unique(targets.rgb, dim=0)) == static


def test_images_are_drawn_as_by_rejection_with_equal_shares_for_sub_fields(tmp_path):
    run = card_run(tmp_path)
    run.pool.show(0)
    _, targets = run.pool.draw(draws(50_000))
    found = np.bincount(targets.rgb[:, 0].numpy(), minlength=4) / 50_000
    share = np.array([1 - Numbered.hidden(row) / 6 for row in range(4)]) / (3, 3, 3, 1)  # cameras of the sub-field
    np.testing.assert_allclose(found, share / share.sum(), atol=0.01)


def test_thin_things_are_drawn_more_often(tmp_path, monkeypatch):
    def load(_: Numbered, row: int) -> FramePixels:
        labels = np.zeros((HEIGHT, WIDTH), np.uint8)
        labels[:, row] = classes.CITYSCAPES.index("pole")
        return FramePixels(np.zeros((HEIGHT, WIDTH, 3), np.uint8), labels, np.zeros((2, 3, 3), np.uint8))

    monkeypatch.setattr(Numbered, "load", load)
    run = card_run(tmp_path, "training.thin_weight=3.0")
    run.pool.show(0)
    _, targets = run.pool.draw(draws(50_000))
    found = float((targets.labels > 0).float().mean())
    assert found == pytest.approx(3 / (3 + WIDTH - 1), abs=0.01)  # one column of twelve


def test_the_largest_random_number_still_draws_a_pixel(tmp_path):
    run = card_run(tmp_path)
    run.pool.show(0)
    below_one = float(np.nextafter(np.float32(1), np.float32(0)))
    _, targets = run.pool.draw(torch.tensor([[below_one, below_one], [0, 0]]))
    assert targets.rgb.tolist() == [[3, WIDTH - 1, HEIGHT - 1], [0, 0, 0]]


def test_a_small_pool_shows_other_images_each_epoch_in_the_same_buffers(tmp_path, monkeypatch):
    monkeypatch.setattr(card_pool, "HOST_BYTES", 1500)  # two images of 714 bytes
    run = card_run(tmp_path, table=frames((0, 1, 2, 3, 4, 40)))
    assert run.pool.capacity == 2
    shown, versions = [], []
    for epoch in range(6):
        run.pool.show(epoch)
        shown.append(set(run.pool.draw(draws(200))[1].rgb[:, 0].tolist()))
        versions.append(run.pool.version)
    run.close()
    assert all(5 in images and len(images) == 2 for images in shown)  # one of each sub-field
    assert len(set.union(*shown)) > 3
    assert versions[-1] == versions[-2]


def test_images_of_nothing_but_traffic_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(Numbered, "hidden", staticmethod(lambda row: 6))
    run = card_run(tmp_path)
    with pytest.raises(InputError, match=r"shorten features\.dynamic_classes"):
        run.pool.show(0)


def test_the_ground_is_where_the_host_finds_it():
    settings, random = GroundSettings(weight=0.1, reach_m=5), np.random.default_rng(0)
    cameras = np.stack([np.linspace(0, 60, 30), np.zeros(30), np.linspace(0, 6, 30)], -1) + np.array([5e5, 0, 40])
    origin_m = cameras.mean(0)
    count = 2000
    directions = random.normal(size=(count, 3)) * (1, 0.3, 0.4)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    labels = random.choice([0, SIDEWALK, classes.SKY], count).astype(np.uint8)
    origins = cameras[random.integers(30, size=count)]
    nothing = np.zeros((count, 3), np.uint8)
    expected = Ground(cameras, settings).stretches(
        PixelBatch(np.zeros(count, np.int64), origins, directions, np.zeros(count), nothing, labels, nothing)
    )
    rays = Rays(*(torch.from_numpy(value.astype(np.float32)) for value in (origins - origin_m, directions)))
    found = CardGround(cameras, origin_m, settings, "cpu").stretches(rays, torch.from_numpy(labels))
    known = np.isfinite(expected.end_m) & torch.isfinite(found[1]).numpy()
    assert (np.isfinite(expected.end_m) != torch.isfinite(found[1]).numpy()).mean() < 0.02  # at the edge of the reach
    assert known.mean() > 0.05
    for one, other in zip(found, expected, strict=True):
        error_m = np.abs(one.numpy()[known] - other[known]) * -directions[known, 2]  # up and down
        assert np.median(error_m) < 0.02
        assert error_m.max() < 0.25  # two places of cameras farther: the next cell asks other ones
    assert (found[0].numpy()[~np.isfinite(found[1].numpy())] == 0).all()


def test_steps_lower_the_loss(tmp_path):
    run = card_run(tmp_path, "training.steps=60", "training.warmup=0.0")
    totals = [float(sum(run.advance(step).values())) for step in range(60)]
    assert np.mean(totals[-5:]) < np.mean(totals[:5]) / 2


def test_a_step_depends_on_the_seed_and_its_number_alone(tmp_path):
    fields = []
    for name in ("one", "other"):
        run = card_run(tmp_path / name)
        for step in range(3):
            run.advance(step)
        fields.append(run.field.state_dict())
    assert all(torch.equal(fields[0][name], fields[1][name]) for name in fields[0])


def test_a_tile_trains_and_resumes_on_the_card_path(tmp_path, monkeypatch):
    monkeypatch.setattr(card_training, "suits", lambda job: True)
    settings = tiny_settings("training.steps=4", "training.checkpoint_every=2")
    job = TileTraining("t000", frames(), SUB_FIELDS, settings, feature_channels=3)
    result = train_tile(job, Numbered(), tmp_path)
    assert load_field(result.folder).shape.feature_channels == 3
    assert np.isfinite(result.metrics["loss"])
    again = CardRun(job, tmp_path, Numbered(), np.arange(4))
    assert again.step == 4


def test_only_cards_with_bfloat16_record_steps(monkeypatch):
    monkeypatch.setattr("presight_core.field.threads.has_fast_bfloat16", lambda device: True)
    assert card_training.suits(TileTraining("t", frames(), SUB_FIELDS, tiny_settings(), 3, device="cuda:1"))
    assert not card_training.suits(TileTraining("t", frames(), SUB_FIELDS, tiny_settings(), 3, device="cpu"))
    exact = tiny_settings("training.bfloat16=false")
    assert not card_training.suits(TileTraining("t", frames(), SUB_FIELDS, exact, 3, device="cuda"))


@pytest.mark.slow
def test_nothing_in_a_step_waits_for_the_card_and_its_losses_are_right(tmp_path):
    pytest.importorskip("triton", minversion="3.9")
    on_card = interpreted("tests.stages.step_interpreted", tmp_path / "card")
    assert on_card["waiting"] == []
    on_host = interpreted("tests.stages.step_interpreted", tmp_path / "host", interpret=False)
    assert on_host["waiting"] == ["tolist"]  # so the watch sees what waits
    assert on_card["losses"] == pytest.approx(on_host["losses"], rel=1e-5)


class FakeGraph:
    """Counts replays."""

    replays = 0

    def replay(self) -> None:
        self.replays += 1


class Nothing:
    """A context, stream or device that does nothing."""

    device = None

    def __init__(self, *_: object, **__: object) -> None: ...
    def __enter__(self) -> None: ...
    def __exit__(self, *_: object) -> None: ...
    def wait_stream(self, _: object) -> None: ...


def test_a_recording_runs_then_records_then_replays(monkeypatch):
    fake = SimpleNamespace(CUDAGraph=FakeGraph, graph=Nothing, stream=Nothing, current_stream=Nothing)
    monkeypatch.setattr(card_training.torch, "cuda", fake)
    calls = []
    recording = card_training.Recording(lambda: calls.append(0) or {"loss": len(calls)}, None, Nothing())
    results = [recording()["loss"] for _ in range(6)]
    assert results == [1, 2, 3, 4, 4, 4]  # three runs, one recording, and its result ever after
    assert recording._graph.replays == 3
