"""A prepared toy city for every fault, and how many faults: few in every run, many in `make torture`."""

import os
import shutil
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

from tests.torture import children
from tests.torture.toy_city import ToyCity

LONG = "PRESIGHT_TORTURE"

# What the pipeline imports when it first needs it: each child would do so anew, and spend half of its time there.
for late in (
    "pyarrow.dataset",
    "rich._emoji_codes",
    "safetensors.numpy",
    "sqlalchemy.dialects.sqlite",
    "storage.artifacts",
    "storage.migrations.upgrade",
):
    import_module(late)


@pytest.fixture(scope="session")
def is_long() -> bool:
    """Whether this is the long run."""
    return bool(os.environ.get(LONG))


@pytest.fixture(autouse=True)
def no_child_stays() -> Iterator[None]:
    """A test that fails leaves no process behind."""
    yield
    children.end_all()


@pytest.fixture(scope="session")
def prepared(tmp_path_factory) -> ToyCity:
    """A toy city into which nothing was ingested."""
    folder = tmp_path_factory.mktemp("prepared")
    city = ToyCity(folder / "workspace", folder / "data")
    children.result(city.prepare, folder / "log")
    return city


@pytest.fixture(scope="session")
def truth(prepared, tmp_path_factory) -> dict[str, str]:
    """The digests of the tiles after a run without faults."""
    return children.result(whole_run(copy_of(prepared, tmp_path_factory.mktemp("truth"))), prepared.root / "log")


@pytest.fixture
def city(prepared, tmp_path) -> ToyCity:
    """A copy of the prepared city, for one test."""
    return copy_of(prepared, tmp_path)


def copy_of(city: ToyCity, folder: Path) -> ToyCity:
    """Another workspace for the same data."""
    root = folder / "workspace"
    shutil.rmtree(root, ignore_errors=True)
    shutil.copytree(city.root, root)
    return ToyCity(root, city.data, city.side_blocks)


def whole_run(city: ToyCity):
    """Ingest, build, and check what came of it; the digests."""

    def work() -> dict[str, str]:
        city.ingest()
        city.build()
        city.check_catalog()
        return city.check()

    return work
