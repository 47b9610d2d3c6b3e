"""The two occupancy models: interface, learning, sources, history, published sizes."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from presight_core.errors import InputError, SettingsError
from presight_perception.metrics import OccupancyIou
from presight_perception.models.bev_features import Sources
from presight_perception.models.bevdet_occ import BevDetOcc, BevDetOccSettings
from presight_perception.models.camera_rig import CameraRig
from presight_perception.models.fb_occ import FbOcc, FbOccSettings
from presight_perception.models.lift_splat import LiftSettings
from presight_perception.models.occ_frames import PastFrame
from presight_perception.models.occ_model import OccupancyModel
from tests.perception import toy_occupancy, toy_rig
from tests.perception.toy_occupancy import CAMERAS, MODELS, PRIOR

SEEN = toy_rig.pictures(), toy_rig.rig()
DEPTH_M = torch.full((2, *toy_rig.SIZE), 5.0)  # of one sample's cameras


def targets(model: OccupancyModel) -> list:
    return [model.truth_of(truth, DEPTH_M) for truth in toy_occupancy.truths()]


def learn(model: OccupancyModel, step_count: int) -> list[float]:
    """The losses of training on one batch."""
    prior = toy_occupancy.prior() if model.fusion else None
    optimiser, losses, truths = torch.optim.AdamW(model.parameters(), 3e-2), [], targets(model)
    for _ in range(step_count):
        loss = sum(model.loss(model(*SEEN, prior, [toy_occupancy.earlier()]), truths).values())
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 35.0)
        optimiser.step()
        losses.append(loss.item())
    return losses


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_a_model_learns_one_batch_by_heart(name):
    model = toy_occupancy.model(name, CAMERAS)
    losses = learn(model, {"bevdet": 10, "fb": 20}[name])
    assert np.mean(losses[-3:]) < losses[0] / 3
    scores, predictions = OccupancyIou(), model(*SEEN, history=[toy_occupancy.earlier()])
    for found, truth in zip(model.decode(predictions), toy_occupancy.truths(), strict=True):
        scores.add(found, model.in_range(truth))
    assert scores.result().per_class["driveable_surface"] > 0.8


@pytest.mark.parametrize("name", MODELS)
def test_every_weight_learns(name):
    model = toy_occupancy.model(name)
    learn(model, 2)  # in the first step, attention looks straight ahead, wherever its cell is
    assert [key for key, weight in model.named_parameters() if weight.grad is None or not weight.grad.any()] == []


@pytest.mark.parametrize("name", MODELS)
def test_predictions_are_on_the_grid_of_the_truth(name):
    model = toy_occupancy.model(name).eval()
    predictions = model(*SEEN, toy_occupancy.prior())
    assert predictions.logits.shape == (2, 32, 32, 8, 18)
    assert [(sample.shape, sample.dtype) for sample in model.decode(predictions)] == [((32, 32, 8), np.uint8)] * 2


@pytest.mark.parametrize("name", MODELS)
def test_a_prior_changes_what_is_found(name):
    model = toy_occupancy.model(name).eval()
    with_prior, without = model(*SEEN, toy_occupancy.prior()).logits, model(*SEEN).logits
    assert (with_prior - without).abs().max() > 1e-3


@pytest.mark.parametrize("name", MODELS)
def test_without_images_the_cameras_part_is_zeros(name):
    model = toy_occupancy.model(name).eval()
    x, y, z = toy_occupancy.GRID.shape
    zeros = torch.zeros(2, model.channels, z, y, x)
    prior = toy_occupancy.prior()
    fused = model.fusion(zeros.permute(0, 1, 3, 4, 2), prior.voxels, prior.coordinates).permute(0, 1, 4, 2, 3)
    torch.testing.assert_close(model(None, None, prior).logits, model.classify(fused))


@pytest.mark.parametrize("name", MODELS)
def test_a_model_of_the_prior_alone_has_no_camera_parts(name):
    model = toy_occupancy.model(name, PRIOR)
    parts = {key for key, _ in model.named_children()}
    assert parts == {"fusion", "encoder", "neck", "head"}
    sum(model.loss(model(None, None, toy_occupancy.prior()), targets(model)).values()).backward()
    assert all(weight.grad is not None for weight in model.parameters())


@pytest.mark.parametrize("name", MODELS)
def test_history_changes_what_is_found(name):
    model = toy_occupancy.model(name, CAMERAS).eval()
    now, before = model(*SEEN).logits, model(*SEEN, history=[toy_occupancy.earlier()]).logits
    assert (now - before).abs().max() > 1e-3


@pytest.mark.parametrize("name", MODELS)
def test_a_batch_is_seen_like_its_samples_alone(name):
    model = toy_occupancy.model(name, CAMERAS, earlier_frames=2).eval()
    images, rig = toy_rig.pictures(), toy_rig.rig()
    turned = rig.augmented(
        torch.tensor([[[1.0, 0, 0], [0, 1, 0], [0, 0, 1]], [[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]]])
    )
    together = model(images, turned, history=[toy_occupancy.earlier()]).logits
    for sample in range(2):
        own = slice(sample, sample + 1)
        frame = toy_occupancy.earlier()
        history = [PastFrame(frame.past_from_now[own], frame.age_s[own], frame.images[own], toy_rig.rig(1))]
        alone = model(images[own], CameraRig(turned.intrinsics[own], turned.ego_from_camera[own]), history=history)
        torch.testing.assert_close(together[own], alone.logits, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("name", MODELS)
def test_remembered_voxels_spare_an_earlier_frames_images(name):
    model = toy_occupancy.model(name, CAMERAS).eval()
    frame = replace(toy_occupancy.earlier(), past_from_now=torch.eye(4).repeat(2, 1, 1))
    remembered = replace(frame, voxels=model(frame.images, frame.rig).voxels, images=None, rig=None)
    expected = model(*SEEN, history=[frame]).logits
    torch.testing.assert_close(model(*SEEN, history=[remembered]).logits, expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("name", MODELS)
def test_voxels_that_no_camera_saw_do_not_count(name):
    model = toy_occupancy.model(name, CAMERAS).eval()
    predictions, truths = model(*SEEN), toy_occupancy.truths()
    expected = model.loss(predictions, [model.truth_of(truth) for truth in truths])
    changed = [replace(truth, semantics=np.where(truth.mask_camera, truth.semantics, 4)) for truth in truths]
    torch.testing.assert_close(model.loss(predictions, [model.truth_of(truth) for truth in changed]), expected)


@pytest.mark.parametrize("name", MODELS)
def test_truth_on_another_grid_is_an_error(name):
    model = toy_occupancy.model(name, CAMERAS).eval()
    truths = [replace(truth, classes=truth.classes[:16]) for truth in targets(model)]
    with pytest.raises(InputError, match=r"predicted voxels \(2, 32, 32, 8\), true ones \(2, 16, 32, 8\)"):
        model.loss(model(*SEEN), truths)


@pytest.mark.parametrize("name", MODELS)
def test_a_model_wants_at_least_one_source(name):
    with pytest.raises(SettingsError, match="cameras or a prior"):
        toy_occupancy.model(name, Sources(cameras=False))
    with pytest.raises(InputError, match="neither images"):
        toy_occupancy.model(name)(None, None)
    with pytest.raises(InputError, match="model without prior"):
        toy_occupancy.model(name, CAMERAS)(*SEEN, toy_occupancy.prior())


@pytest.mark.parametrize("name", MODELS)
def test_a_model_is_scored_by_the_voxels_that_it_predicts(name):
    model, (truth, _) = toy_occupancy.model(name), toy_occupancy.truths()
    truth.semantics[84, 115, 0] = 4  # the first along x, the last along y, the first along z
    found = model.in_range(truth).semantics
    assert found.shape == (32, 32, 8)
    assert (found == 4).nonzero() == (0, 31, 0)


def test_truth_must_cover_the_grid():
    truth = toy_occupancy.truths()[0]
    smaller = replace(truth, semantics=truth.semantics[:100])
    with pytest.raises(InputError, match="does not cover"):
        toy_occupancy.model("fb").in_range(smaller)


def test_an_earlier_frame_needs_images_or_voxels():
    model = toy_occupancy.model("bevdet", CAMERAS)
    with pytest.raises(InputError, match="neither voxels nor images"):
        model(*SEEN, history=[replace(toy_occupancy.earlier(), images=None)])


def parameter_count(model: OccupancyModel) -> int:
    return sum(weight.numel() for weight in model.parameters())


def test_the_single_frame_model_has_as_many_weights_as_published():
    """FlashOcc's table gives 29.02 million for BEVDet-Occ of one frame, whose depth net is one convolution."""
    with torch.device("meta"):
        model = BevDetOcc(replace(BevDetOccSettings.paper(), earlier_frames=0, lift=LiftSettings(camera_aware=False)))
    assert parameter_count(model) == pytest.approx(29.02e6, rel=2e-4)


@pytest.mark.parametrize(("kind", "settings"), [(BevDetOcc, BevDetOccSettings), (FbOcc, FbOccSettings)])
def test_a_prior_adds_as_many_weights_as_the_released_fusion_has(kind, settings):
    with torch.device("meta"):
        with_prior, without = kind(settings.paper(Sources(prior_channels=68))), kind(settings.paper())
    added = parameter_count(with_prior) - parameter_count(without)
    released = {BevDetOcc: 932_928, FbOcc: 936_816}  # 80 channels and 8 heights instead of 64 and 16
    assert added == released[kind]
