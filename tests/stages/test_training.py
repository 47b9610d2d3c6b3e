import numpy as np
import pytest
import torch

from presight_core import classes
from presight_core.errors import BuildError, InputError
from presight_core.field.checkpoint import load_field
from presight_core.pixels import FramePixels
from presight_core.progress import Progress
from stages import feeding
from stages.evaluation import Evaluation, evaluate_tile
from stages.ray_pool import RayPool, draw_static
from stages.training import holdout_mask, image_numbers, train_tile, training_rows
from tests.stages.small_training import Gradient, street, tiny_job, tiny_settings


def parameters_of(folder) -> dict[str, torch.Tensor]:
    return dict(load_field(folder).named_parameters())


def test_training_lowers_the_loss(tmp_path):
    seen: list[Progress] = []
    overrides = ("training.steps=60", "training.checkpoint_every=10", "training.warmup=0.0")
    train_tile(tiny_job(*overrides), Gradient(), tmp_path, seen.append)
    assert seen[-1].done == seen[-1].total == 60
    assert seen[-1].figures["loss"] < seen[1].figures["loss"] / 2  # the first report says only that it begins
    assert set(seen[-1].figures) == {"loss", "psnr_db", "rays_per_s", "waiting_share"}


def test_a_field_may_do_without_proposals(tmp_path):
    seen: list[Progress] = []
    without = ("field.proposals=[]", "sampling.proposal_samples=[]", "sampling.field_samples=20")
    trained = train_tile(
        tiny_job("training.steps=60", "training.warmup=0.0", *without), Gradient(), tmp_path, seen.append
    )
    assert seen[-1].figures["loss"] < seen[1].figures["loss"] / 2
    assert not any(name.startswith("proposals") for name in parameters_of(trained.folder))


def test_an_interrupted_training_ends_as_an_uninterrupted_one(tmp_path):
    job = tiny_job()
    whole = train_tile(job, Gradient(), tmp_path / "whole")

    def interrupt(progress: Progress) -> None:
        if progress.done >= 12:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_tile(job, Gradient(), tmp_path / "parts", interrupt)
    seen: list[Progress] = []
    resumed = train_tile(job, Gradient(), tmp_path / "parts", seen.append)
    assert seen[0].done == 6
    expected = parameters_of(whole.folder)
    for name, parameter in parameters_of(resumed.folder).items():
        assert torch.equal(parameter, expected[name]), name


def test_a_finished_training_is_not_repeated(tmp_path):
    job = tiny_job()
    first = train_tile(job, Gradient(), tmp_path)
    seen: list[Progress] = []
    again = train_tile(job, Gradient(), tmp_path, seen.append)
    assert seen == []
    assert again.metrics == first.metrics


def test_a_checkpoint_of_other_settings_is_not_resumed(tmp_path):
    train_tile(tiny_job(), Gradient(), tmp_path)
    seen: list[Progress] = []
    train_tile(tiny_job("training.learning_rate=0.02"), Gradient(), tmp_path, seen.append)
    assert seen[-1].done == 12


def test_a_damaged_checkpoint_starts_over(tmp_path):
    train_tile(tiny_job(), Gradient(), tmp_path)
    (tmp_path / "training.safetensors").write_bytes(b"not a checkpoint")
    seen: list[Progress] = []
    train_tile(tiny_job(), Gradient(), tmp_path, seen.append)
    assert seen[-1].done == 12


def test_the_seed_alone_decides_the_field(tmp_path):
    fields = [
        parameters_of(train_tile(tiny_job(f"training.seed={seed}"), Gradient(), tmp_path / str(i)).folder)
        for i, seed in enumerate((1, 1, 2))
    ]
    assert all(torch.equal(fields[0][name], fields[1][name]) for name in fields[0])
    assert not torch.equal(fields[0]["trunk.grid.table"], fields[2]["trunk.grid.table"])


def test_a_loss_that_is_no_number_stops_the_build(tmp_path):
    with pytest.raises(BuildError, match=r"lower training\.learning_rate"):
        train_tile(tiny_job("training.learning_rate=1e30"), Gradient(), tmp_path)


def test_a_tile_without_training_frames_is_refused(tmp_path):
    frames = street(1)
    job = tiny_job("training.holdout_every=1", frames=frames)
    with pytest.raises(InputError, match="none of its 1 frames"):
        train_tile(job, Gradient(), tmp_path)


def test_held_out_frames_lie_between_trained_ones():
    frames = street(16, drives=2)
    assert np.flatnonzero(holdout_mask(frames, 4)).tolist() == [2, 6, 10, 14]
    assert not holdout_mask(frames, 0).any()


def test_keyframes_only_leaves_sweeps_out():
    settings = tiny_settings("training.keyframes_only=true", "training.holdout_every=0").training
    assert training_rows(street(8), settings).tolist() == [0, 2, 4, 6]


def test_only_trained_images_have_an_embedding(tmp_path):
    job = tiny_job("training.steps=1")
    numbers = image_numbers(job.frames, job.settings.training)
    assert numbers.tolist() == [0, 1, -1, 2, 3, 4, -1, 5]
    field = load_field(train_tile(job, Gradient(), tmp_path).folder)
    assert len(field.image_embedding.weight) == 6


def test_drawn_pixels_match_their_image_and_show_nothing_dynamic():
    frames = street()
    pool = RayPool(frames, Gradient(), np.array([1, 4]))
    batch = draw_static(pool, 200, [np.array([0]), np.array([1])], np.random.default_rng(0), classes.DYNAMIC)
    assert len(batch.rows) == 200
    assert set(batch.rows.tolist()) == {1, 4}
    is_sky = batch.labels == classes.SKY
    assert set(batch.labels.tolist()) == {0, classes.SKY}
    assert (batch.directions_world[is_sky, 2] > 0).all()
    assert (batch.directions_world[~is_sky, 2] < 0).all()
    assert (batch.rgb[~is_sky, 0] == 70 + batch.rows[~is_sky]).all()
    assert (batch.features[:, 0] == np.where(is_sky, 0, 255)).all()


def test_rays_pass_through_the_centres_of_their_pixels():
    frames = street()
    pool = RayPool(frames, Gradient(), np.array([3]))
    batch = pool.at(np.array([0, 0]), np.array([[5, 9], [20, 2]]))
    pixels, _ = frames.camera_of(3).project(batch.origins_world + 7 * batch.directions_world)
    np.testing.assert_allclose(pixels, (np.array([[5, 9], [20, 2]]) + 0.5) * 2)  # full resolution is twice as fine


def test_sub_fields_are_drawn_equally_often():
    pool = RayPool(street(), Gradient(), np.arange(8))
    batch = pool.draw(4000, [np.array([0]), np.arange(1, 8)], np.random.default_rng(0))
    assert np.mean(batch.rows == 0) == pytest.approx(0.5, abs=0.05)


def test_images_of_nothing_but_traffic_are_refused():
    class Traffic(Gradient):
        def load(self, row: int) -> FramePixels:
            pixels = super().load(row)
            return FramePixels(pixels.rgb, np.full_like(pixels.labels, 13), pixels.features)

    pool = RayPool(street(), Traffic(), np.arange(2))
    with pytest.raises(InputError, match="hardly anything but"):
        draw_static(pool, 10, [np.arange(2)], np.random.default_rng(0), classes.DYNAMIC)


def test_pools_that_do_not_fit_take_turns(tmp_path, monkeypatch):
    loaded = []

    class Counting(Gradient):
        def load(self, row: int) -> FramePixels:
            loaded.append(row)
            return super().load(row)

    monkeypatch.setattr(feeding, "POOL_BYTES", 3 * 1500)  # an image is about 1300 bytes
    monkeypatch.setattr(feeding, "POOL_STEPS", 4)
    train_tile(tiny_job(), Counting(), tmp_path)
    assert len(loaded) == 1 + 3 * 3  # one to know the size, then three images for each of three pools
    assert set(loaded).isdisjoint({2, 6})  # held out


def test_evaluation_reports_the_held_out_frames_and_draws_them(tmp_path):
    job = tiny_job("training.steps=30")
    field = load_field(train_tile(job, Gradient(), tmp_path).folder)
    evaluation = evaluate_tile(job, field, Gradient(), tmp_path / "pictures")
    figures = evaluation.metrics
    assert set(figures) == {"psnr_db", "psnr_own_video_db", "feature_rmse", "found_share", "sky_share"}
    assert figures["psnr_db"] > 10
    assert evaluation.drive_psnr_db == {"drive0": pytest.approx(figures["psnr_own_video_db"])}
    assert (tmp_path / "pictures" / "rows.png").stat().st_size > 0


def test_evaluation_without_held_out_frames_is_empty(tmp_path):
    job = tiny_job("training.holdout_every=0", "training.steps=1")
    field = load_field(train_tile(job, Gradient(), tmp_path).folder)
    assert evaluate_tile(job, field, Gradient(), tmp_path / "pictures") == Evaluation({}, {})


def test_an_image_that_cannot_be_read_stops_the_training(tmp_path, monkeypatch):
    class Broken(Gradient):
        def load(self, row: int) -> FramePixels:
            if row == 5:
                raise InputError("5.jpg: broken; copy it again")
            return super().load(row)

    monkeypatch.setattr(feeding, "POOL_BYTES", 3 * 1500)  # an image is about 1300 bytes
    monkeypatch.setattr(feeding, "POOL_STEPS", 2)  # so that it is not in the first pool, but in one of them
    with pytest.raises(InputError, match=r"5\.jpg"):
        train_tile(tiny_job(), Broken(), tmp_path)


def test_images_larger_than_the_first_fit_into_a_pool():
    class Growing(Gradient):
        def load(self, row: int) -> FramePixels:
            pixels = super().load(row)
            return FramePixels(np.repeat(pixels.rgb, row + 1, 0), pixels.labels, pixels.features)

    pool = RayPool(street(), Growing(), np.array([0, 2, 3]))
    assert [pool.size_px(image) for image in range(3)] == [(24, 16), (24, 48), (24, 64)]
    batch = pool.at(np.array([0, 1, 2]), np.array([[0, 15], [0, 47], [23, 63]]))
    assert batch.rgb[:, 0].tolist() == [70, 72, 73]  # the lowest rows: road


def test_the_next_batch_is_the_same_whether_drawn_ahead_or_not():
    job = tiny_job()
    rows = training_rows(job.frames, job.settings.training)
    with feeding.Feed(job, Gradient(), rows) as one, feeding.Feed(job, Gradient(), rows) as other:
        ahead = [one.batch(step) for step in (3, 4, 5)][-1]
        np.testing.assert_array_equal(other.batch(5).directions_world, ahead.directions_world)
