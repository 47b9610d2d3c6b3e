"""Fixtures that every test may use."""

import os
from pathlib import Path

import pytest

from tests.tiny_dataset import TinyDataset

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real drives and golden values; skips the test, naming it, where it is absent."""
    folder = Path(os.environ.get("PRESIGHT_SHARED", REPOSITORY.parent / "shared")) / "data"
    if not folder.is_dir():
        pytest.skip(f"{folder} is absent: set PRESIGHT_SHARED to the folder that holds data/")
    return folder


@pytest.fixture
def tiny(tmp_path: Path) -> TinyDataset:
    """A sound data set in the nuScenes format, not yet written."""
    return TinyDataset(tmp_path / "data")
