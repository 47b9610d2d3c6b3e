"""Running one golden case."""

import json
from pathlib import Path

import numpy as np

from tests.golden.adapters import adapter_of
from tests.golden.cases import Check


def golden_files(folder: Path) -> list[Path]:
    """All files of golden values in a folder or below it."""
    return [file for file in sorted(folder.rglob("*")) if file.suffix in (".npz", ".json")]


def checks_of(file: Path) -> list[Check]:
    """The comparisons of one golden file. Raises LookupError if it has no adapter, or lacks what one needs."""
    adapter = adapter_of(file.stem)
    if adapter is None:
        raise LookupError(f"no adapter for {file.stem}")
    if file.suffix == ".json":
        return adapter(json.loads(file.read_text()))
    with np.load(file, allow_pickle=False) as opened:
        golden = {name: opened[name] for name in opened.files}
    return adapter(golden)
