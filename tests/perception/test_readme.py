"""The example in perception/README.md."""

import re
from pathlib import Path

import torch

from presight_core import frames

README = Path(__file__).resolve().parents[2] / "perception" / "README.md"


def test_the_readmes_example_fuses_a_prior(town):
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    names = {
        "store": town,
        "city": "town",
        "mine": [{"world_from_ego": frames.planar_transform(i, 0.0, 0.0), "drive": f"drive-{i}"} for i in range(2)],
        "encoder": lambda batch: torch.zeros(len(batch["drive"]), 256, 50, 100),
    }
    exec(code, names)
    assert names["bev"].shape == (2, 256, 50, 100)
    assert len(names["prior"].voxels) > 100
