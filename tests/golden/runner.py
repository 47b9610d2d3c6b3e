"""Running one golden case."""

from pathlib import Path

import numpy as np

from tests.golden.adapters import ADAPTERS
from tests.golden.cases import Check


def checks_of(file: Path) -> list[Check]:
    """The comparisons of one golden file, which has an adapter."""
    with np.load(file, allow_pickle=False) as opened:
        golden = {name: opened[name] for name in opened.files}
    return ADAPTERS[file.stem](golden)
