"""A field that goes on from an earlier one: what it keeps, and that nothing else decides the result."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from presight_core.errors import InputError
from presight_core.field.checkpoint import load_field
from presight_core.field.tile_field import TileField
from presight_core.progress import Progress
from stages.training import TileTraining, image_numbers, lens_numbers, train_tile
from stages.warm_start import FieldStart, go_on_from
from tests.stages.small_training import Gradient, street, tiny_job

FRAMES = street(16, drives=2)  # drive0, then drive1
OLD = FRAMES.select(FRAMES.drive_id == "drive1")
LONG = ("training.steps=60", "training.warmup=0.0")


@pytest.fixture(scope="module")
def earlier(tmp_path_factory) -> FieldStart:
    """The field of a tile that knew drive1 only."""
    folder = train_tile(tiny_job(*LONG, frames=OLD), Gradient(), tmp_path_factory.mktemp("earlier")).folder
    return FieldStart(folder, "name", ("drive1",))


def warm_job(start: FieldStart, *overrides: str) -> TileTraining:
    return replace(tiny_job(*overrides, frames=FRAMES), start=start)


def new_field(start: FieldStart) -> tuple[TileField, np.ndarray]:
    """A field for both drives that went on from the earlier one, and the numbers of its images."""
    job = tiny_job(frames=FRAMES)
    images = image_numbers(FRAMES, job.settings.training)
    shape = replace(load_field(start.folder).shape, video_count=2, image_count=int(images.max()) + 1, lens_count=2)
    field = TileField(shape)
    go_on_from(start, field, FRAMES, images, lens_numbers(FRAMES))
    return field, images


def test_it_keeps_every_parameter_of_the_earlier_one(earlier):
    field, old = new_field(earlier)[0], dict(load_field(earlier.folder).named_parameters())
    for name, parameter in field.named_parameters():
        if "embedding" not in name and "lenses" not in name:
            assert torch.equal(parameter, old[name]), name


def test_known_videos_and_images_keep_their_rows_and_new_ones_get_the_mean(earlier):
    (field, images), old = new_field(earlier), load_field(earlier.folder)
    mean = old.video_embedding.weight.mean(0)
    torch.testing.assert_close(field.video_embedding.weight, torch.stack([mean, old.video_embedding.weight[0]]))
    known = np.sort(images[(FRAMES.drive_id == "drive1") & (images >= 0)])
    assert torch.equal(field.image_embedding.weight[known], old.image_embedding.weight)
    others = np.setdiff1d(images[images >= 0], known)
    mean = old.image_embedding.weight.mean(0)
    torch.testing.assert_close(field.image_embedding.weight[others], mean.repeat(len(others), 1))


def test_known_cameras_keep_their_falloff_and_new_ones_begin_with_the_mean(earlier):
    field, old = new_field(earlier)[0], load_field(earlier.folder)
    assert field.lenses is not None and old.lenses is not None
    assert old.lenses.terms.abs().min() > 0
    assert torch.equal(field.lenses.terms, old.lenses.terms.expand(2, -1))  # one known camera, whose row is the mean


def test_rows_that_cannot_be_told_get_the_mean(earlier):
    field = new_field(replace(earlier, drives=("drive0", "drive1")))[0]
    mean = load_field(earlier.folder).image_embedding.weight.mean(0)
    torch.testing.assert_close(field.image_embedding.weight, mean.expand_as(field.image_embedding.weight))


def test_a_field_of_another_shape_is_refused(earlier):
    field = TileField(replace(load_field(earlier.folder).shape, feature_channels=4))
    with pytest.raises(InputError, match="another field's feature_channels"):
        images = image_numbers(FRAMES, tiny_job().settings.training)
        go_on_from(earlier, field, FRAMES, images, lens_numbers(FRAMES))


def loss_of(job: TileTraining, scratch: Path) -> float:
    return train_tile(job, Gradient(), scratch).metrics["loss"]


def test_it_is_better_after_few_steps_than_one_that_begins_with_nothing(earlier, tmp_path):
    warm, cold = warm_job(earlier), tiny_job(frames=FRAMES)
    assert loss_of(warm, tmp_path / "warm") < 0.7 * loss_of(cold, tmp_path / "cold")


def test_the_same_start_gives_the_same_field(earlier, tmp_path):
    first, second = (
        load_field(train_tile(warm_job(earlier), Gradient(), tmp_path / name).folder).state_dict() for name in "ab"
    )
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_an_interrupted_warm_training_ends_as_an_uninterrupted_one(earlier, tmp_path):
    whole = train_tile(warm_job(earlier), Gradient(), tmp_path / "whole")

    def interrupt(progress: Progress) -> None:
        if progress.done >= 12:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_tile(warm_job(earlier), Gradient(), tmp_path / "parts", interrupt)
    parts = train_tile(warm_job(earlier), Gradient(), tmp_path / "parts")
    expected, found = load_field(whole.folder).state_dict(), load_field(parts.folder).state_dict()
    assert all(torch.equal(expected[name], found[name]) for name in expected)


def test_a_checkpoint_of_another_start_is_not_resumed(earlier, tmp_path):
    train_tile(tiny_job(frames=FRAMES), Gradient(), tmp_path)
    seen: list[Progress] = []
    train_tile(warm_job(earlier), Gradient(), tmp_path, seen.append)
    train_tile(warm_job(replace(earlier, name="another")), Gradient(), tmp_path, seen.append)
    assert [progress.done for progress in seen].count(0) == 2
