"""The three map models: interface, learning, sources, published sizes."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from presight_core.errors import InputError, SettingsError
from presight_perception.metrics import RasterIou, VectorPrecision
from presight_perception.models.bev_features import BevSettings, Sources
from presight_perception.models.line_loss import LinePredictions
from presight_perception.models.map_model import MapModel
from presight_perception.models.map_tr import MapTr, MapTrSettings
from presight_perception.models.raster_mapper import RasterMapper, RasterMapperSettings
from presight_perception.models.stream_map_net import StreamMapNet, StreamMapNetSettings
from presight_perception.models.view_transform import BevFormerSettings
from tests.perception import toy_rig

README = Path(__file__).resolve().parents[2] / "perception" / "README.md"
MODELS = {
    "raster": (RasterMapper, RasterMapperSettings),
    "stream_map_net": (StreamMapNet, StreamMapNetSettings),
    "map_tr": (MapTr, MapTrSettings),
}
BOTH = Sources(prior_channels=6)


def tiny(name: str, sources: Sources | None = None) -> MapModel:
    torch.manual_seed(0)
    model, settings = MODELS[name]
    return model(settings.tiny(sources, toy_rig.GRID))


def with_view(name: str, view: BevFormerSettings) -> MapModel:
    """A tiny model whose images have as many channels as its bird's-eye view."""
    torch.manual_seed(0)
    model, settings = MODELS[name]
    small = settings.tiny(BOTH, toy_rig.GRID)
    bev = replace(small.bev, images=replace(small.bev.images, channels=64), view=view, camera_count=2)
    return model(replace(small, bev=bev))


def learn(model: MapModel, step_count: int, rate: float) -> list[float]:
    """The losses of training on one batch."""
    online = (toy_rig.pictures(), toy_rig.rig()) if model.bev.encoder else (None, None)
    given = *online, toy_rig.prior() if model.bev.fusion else None
    torch.manual_seed(1)  # of the dropout
    truths = [model.truth_of(toy_rig.lines(side)) for side in (1.0, -1.0)]
    optimiser, losses = torch.optim.AdamW(model.parameters(), rate), []
    for _ in range(step_count):
        loss = torch.stack(list(model.loss(model(*given), truths).values())).sum()
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 35.0)
        optimiser.step()
        losses.append(loss.item())
    return losses


def outputs(predictions: torch.Tensor | LinePredictions) -> torch.Tensor:
    """Masks, or the last layer's lines."""
    return predictions.lines[-1] if isinstance(predictions, LinePredictions) else predictions


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_a_model_learns_one_batch_by_heart(name):
    losses = learn(tiny(name, BOTH), 25, 3e-3)
    assert np.mean(losses[-3:]) < losses[0] / 3


@pytest.mark.slow
@pytest.mark.parametrize("sampling", ["learned", "kernel"])
def test_a_model_with_attention_to_images_learns_too(sampling):
    settings = BevFormerSettings((0.0, 1.5), heads=2, points=2, self_heads=2, feedforward=64, sampling=sampling)
    losses = learn(with_view("stream_map_net", settings), 15, 3e-3)
    assert np.mean(losses[-3:]) < losses[0] / 3


@pytest.mark.slow
def test_training_is_the_same_twice():
    assert learn(tiny("map_tr", BOTH), 2, 1e-3) == learn(tiny("map_tr", BOTH), 2, 1e-3)


@pytest.mark.parametrize("name", MODELS)
def test_every_weight_learns(name):
    views = BevFormerSettings((0.0, 1.5), heads=2, points=2, self_heads=2, feedforward=64)
    for model in (tiny(name, BOTH), with_view(name, views)):
        learn(model, 2, 1e-3)  # what begins as zeros lets gradients through after a step
        idle = [name for name, weight in model.named_parameters() if weight.grad is None or not weight.grad.any()]
        assert idle == []


def test_map_tr_moves_points_from_where_the_last_layer_left_them():
    model = tiny("map_tr").eval()
    assert isinstance(model, MapTr)
    for name, weight in model.refine.named_parameters():
        torch.nn.init.constant_(weight, 0.5 if name.endswith("4.bias") else 0.0)  # of the last of five layers
    with torch.no_grad():
        places = model(toy_rig.pictures(), toy_rig.rig()).lines.logit()
    torch.testing.assert_close(places[1], places[0] + 0.5, atol=1e-3, rtol=0)


@pytest.mark.parametrize("name", ["stream_map_net", "map_tr"])
def test_vector_models_begin_by_hardly_believing_in_any_line(name):
    predictions = tiny(name)(toy_rig.pictures(), toy_rig.rig())
    assert predictions.logits.sigmoid().mean() < 0.05


@pytest.mark.parametrize("name", ["stream_map_net", "map_tr"])
def test_vector_models_give_the_metric_lines_in_metres(name):
    model = tiny(name).eval()
    decoded = model.decode(model(toy_rig.pictures(), toy_rig.rig()))
    assert len(decoded) == 2
    metric = VectorPrecision()
    metric.add(decoded[0], toy_rig.lines())
    points = np.stack(decoded[0].lines)
    assert points.shape == (30, 10, 2)
    assert (np.abs(points) <= [12, 6]).all()
    assert 0 <= metric.result().mean <= 1


def test_the_raster_model_gives_the_metric_masks():
    model = tiny("raster").eval()
    masks = model.decode(model(toy_rig.pictures(), toy_rig.rig()))
    truth = model.truth_of(toy_rig.lines())
    metric = RasterIou()
    metric.add(masks[0], truth.numpy() > 0)
    assert truth.shape == (3, 12, 24)


def test_true_masks_are_not_mirrored():
    """A kerb on the left is in the upper rows, a crossing in front in the right columns."""
    truth = tiny("raster").truth_of(toy_rig.lines())
    crossing, kerb = truth[0].nonzero(), truth[2].nonzero()
    assert (kerb[:, 0] > 6).all()
    assert (crossing[:, 1] > 12).all()


@pytest.mark.parametrize("name", MODELS)
def test_exact_predictions_are_perfect_in_the_metric(name):
    model, lines = tiny(name), toy_rig.lines()
    truth = model.truth_of(lines)
    if name == "raster":
        metric = RasterIou()
        metric.add(model.decode(truth[None] * 2.0 - 1)[0], truth.numpy() > 0)
    else:
        logits = torch.full((1, 1, len(truth.labels), 3), -9.0)
        logits[0, 0, torch.arange(len(truth.labels)), truth.labels] = 9.0
        if isinstance(model, MapTr):
            model = MapTr(replace(model.settings, decoded_count=len(truth.labels)))
        metric = VectorPrecision()
        metric.add(model.decode(LinePredictions(logits, truth.lines[None, None, :, 0]))[0], lines)
    assert metric.result().mean == pytest.approx(1.0)


@pytest.mark.parametrize("name", MODELS)
def test_a_prior_changes_predictions_and_its_absence_does_not_stop_them(name):
    model, given = tiny(name, BOTH).eval(), (toy_rig.pictures(), toy_rig.rig())
    with_prior, without = outputs(model(*given, toy_rig.prior())), outputs(model(*given))
    assert not torch.allclose(with_prior, without)


@pytest.mark.parametrize("name", MODELS)
def test_predictions_depend_on_the_pictures(name):
    model, rig = tiny(name).eval(), toy_rig.rig()
    assert not torch.allclose(outputs(model(toy_rig.pictures(), rig)), outputs(model(1 - toy_rig.pictures(), rig)))


@pytest.mark.parametrize("name", MODELS)
def test_without_pictures_a_full_model_sees_only_the_prior(name):
    """Table 7, setting a: the online features are zeros."""
    model, prior = tiny(name, BOTH).eval(), toy_rig.prior()
    bev = torch.zeros(2, 64, toy_rig.GRID.rows, toy_rig.GRID.columns)
    assert model.bev.fusion
    expected = model.predict(model.bev.fusion(bev, prior.voxels, prior.coordinates))
    torch.testing.assert_close(outputs(model(None, None, prior)), outputs(expected))


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_a_model_without_cameras_learns_from_the_prior(name):
    """Table 7, setting b."""
    model = tiny(name, Sources(cameras=False, prior_channels=6))
    assert not [name for name, _ in model.named_parameters() if "encoder" in name or "view" in name]
    losses = learn(model, 20, 3e-3)
    assert np.mean(losses[-3:]) < losses[0] / 2


def test_a_prior_for_a_model_without_one_is_an_error():
    with pytest.raises(InputError, match="a model without prior"):
        tiny("raster")(toy_rig.pictures(), toy_rig.rig(), toy_rig.prior())


def test_neither_pictures_nor_prior_is_an_error():
    with pytest.raises(InputError, match="give one of them"):
        tiny("raster", BOTH)(None, None)


def test_a_model_without_any_source_is_an_error():
    with pytest.raises(SettingsError, match="needs cameras or a prior"):
        tiny("raster", Sources(cameras=False))


def test_attention_to_images_of_other_channels_is_an_error():
    with pytest.raises(SettingsError, match="cells of 128 channels into images of 256"):
        BevSettings(channels=128)


@pytest.mark.parametrize(
    ("name", "millions"),
    [
        # Summed by hand from the published sizes, without the streaming parts.
        ("stream_map_net", 48.1),  # 23.51 ResNet, 0.75 offsets, 2.69 pyramid, 2.07 BEVFormer, 19.08 decoder
        ("raster", 30.8),  # the same but for a decoder of 1.78
        ("map_tr", 36.1),  # 23.51 ResNet, 1.11 pyramid, 5.77 BEVFormer with kernels, 5.73 decoder
    ],
)
def test_paper_models_have_the_published_sizes(name, millions):
    model, settings = MODELS[name]
    with torch.device("meta"):
        network = model(settings.paper())
    assert sum(weight.numel() for weight in network.parameters()) / 1e6 == pytest.approx(millions, rel=0.01)


def test_the_readmes_example_trains():
    code = re.findall(r"```py\n(.*?)```", README.read_text(), re.DOTALL)[0]  # the map models come first
    vehicle = [(toy_rig.pictures(), toy_rig.rig(), toy_rig.prior(channels=68), [toy_rig.lines()] * 2)]
    names = {"batches": vehicle}
    exec(code, names)
    assert len(names["decoded"]) == 2
