"""Running one golden case."""

import json
from pathlib import Path

import numpy as np

from tests.golden.adapters import ADAPTERS
from tests.golden.cases import Check


def checks_of(file: Path) -> list[Check]:
    """The comparisons of one golden file, which has an adapter."""
    if file.suffix == ".json":
        return ADAPTERS[file.stem](json.loads(file.read_text()))
    with np.load(file, allow_pickle=False) as opened:
        golden = {name: opened[name] for name in opened.files}
    return ADAPTERS[file.stem](golden)
