"""The examples in docs/priors-in-your-model.md."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from presight_core import frames
from presight_perception.openmmlab import LoadPrior

PAGE = Path(__file__).resolve().parents[2] / "docs" / "priors-in-your-model.md"


@pytest.fixture
def examples() -> list[str]:
    return re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)


def test_the_pytorch_example_fuses_a_prior(town, examples):
    names = {
        "store": town,
        "city": "town",
        "mine": [
            {"world_from_ego": frames.planar_transform(i, 0.0, 0.0), "scene_name": f"scene-000{i}"} for i in (0, 1)
        ],
        "encoder": lambda batch: torch.zeros(len(batch["scene_name"]), 256, 50, 100),
    }
    torch.manual_seed(0)
    exec(examples[0], names)
    assert names["bev"].shape == (2, 256, 50, 100)
    assert [place.without_drives for place in names["places"]] == [("drive-0",), ("drive-1",)]


def test_the_pytorch_example_is_twenty_lines(examples):
    lines = [line for line in examples[0].splitlines() if line and not line.startswith(("from", "import"))]
    assert len(lines) <= 20


def test_the_openmmlab_example_loads_and_fuses_a_prior(town, examples):
    names: dict[str, Any] = {}
    exec(examples[1] + examples[2], names)
    results = {
        "location": "town",
        "scene_name": "scene-0001",
        "ego2global_translation": [1.0, 0.0, 0.0],
        "ego2global_rotation": np.eye(3),
    }
    loaded = []
    for example in (names["load_prior"], names["load_prior_for_test"]):
        settings = {key: value for key, value in example.items() if key != "type"}
        LoadPrior(**settings)  # fits as it stands
        load = LoadPrior(**{**settings, "store": str(town), "cities": {"town": 1}})
        loaded.append(load(dict(results)))
    neck = names["PriorNeck"](names["point_cloud_range"], [0.5, 0.5, 0.5], voxel_channels=12, bev_channels=16).eval()
    parts = [[each[key] for each in loaded] for key in ("prior_voxels", "prior_voxels_coords")]
    assert len(parts[0][1]) > 1000  # voxels of the second, which drops none
    with torch.no_grad():
        with_prior, without = (
            neck(torch.zeros(2, 16, 50, 100), *parts),
            neck(torch.zeros(2, 16, 50, 100), *empty(parts)),
        )
    assert with_prior.shape == (2, 16, 50, 100)
    assert not torch.equal(with_prior[1], without[1])


def empty(parts: list[list[np.ndarray]]) -> list[list[np.ndarray]]:
    return [[rows[:0] for rows in part] for part in parts]
