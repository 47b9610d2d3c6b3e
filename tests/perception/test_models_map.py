"""The three map models: interface, learning, sources, published sizes."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from presight_core.errors import InputError, SettingsError
from presight_perception.metrics import RasterIou, ScoredLines, VectorPrecision
from presight_perception.models.bev_features import Sources
from presight_perception.models.map_model import MapModel
from presight_perception.models.map_tr import MapTr, MapTrSettings
from presight_perception.models.raster_mapper import RasterMapper, RasterMapperSettings
from presight_perception.models.stream_map_net import StreamMapNet, StreamMapNetSettings
from presight_perception.models.view_transform import BevFormerSettings
from tests.perception import toy_rig

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
    given = toy_rig.pictures(), toy_rig.rig(), toy_rig.prior() if model.bev.fusion else None
    truths = [model.truth_of(toy_rig.lines(side)) for side in (1.0, -1.0)]
    optimiser, losses = torch.optim.AdamW(model.parameters(), rate), []
    for _ in range(step_count):
        loss = sum(model.loss(model(*given), truths).values())
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 35.0)
        optimiser.step()
        losses.append(loss.item())
    return losses


@pytest.mark.parametrize("name", MODELS)
def test_a_model_learns_one_batch_by_heart(name):
    losses = learn(tiny(name, BOTH), 40, 3e-3)
    assert np.mean(losses[-3:]) < losses[0] / 3
