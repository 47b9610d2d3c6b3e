import pytest
import torch

from flows.machines import available_devices


@pytest.mark.parametrize(("count", "devices"), [(0, ["cpu"]), (2, ["cuda:0", "cuda:1"])])
def test_tiles_go_to_the_cards_there_are_or_to_the_processor(monkeypatch, count, devices):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
    assert list(available_devices()) == devices
