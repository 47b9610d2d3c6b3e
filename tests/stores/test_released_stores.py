"""Every released version of the format is read as the program of its day did, or refused clearly."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from presight_core.errors import StoreError
from presight_core.priors import PriorReader
from presight_core.priors.documents import encode
from storage.verification import verify_city
from tests.stores.make import EVERYWHERE, STORES, window_digest

VERSIONS = sorted(path.name for path in STORES.iterdir() if (path / "expected.json").is_file())


def test_there_is_a_store_of_the_first_version():
    assert "1" in VERSIONS


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("number", [1, 2])
def test_a_released_store_reads_as_it_did(version: str, number: int):
    expected = json.loads((STORES / version / "expected.json").read_text())[str(number)]
    reader = PriorReader.open(STORES / version / "store", "town", number)
    window = reader.window(np.eye(4), **EVERYWHERE)
    assert len(window) == 60
    assert reader.generation.tiles["t000"].entry.digest == expected["tile"]
    assert window_digest(window) == expected["window"]


@pytest.mark.parametrize("version", VERSIONS)
def test_a_released_store_is_sound(version: str):
    result = verify_city(STORES / version / "store", "town", deep=True)
    assert result.faults == []
    assert PriorReader.open(STORES / version / "store", "town", "first").generation.number == 1


@pytest.mark.parametrize("document", ["city.json", "generations/00000002.json"])
def test_a_store_of_the_next_major_version_is_refused_clearly(tmp_path: Path, document: str):
    shutil.copytree(STORES / VERSIONS[-1] / "store", tmp_path / "store")
    file = tmp_path / "store/town" / document
    value = {key: item for key, item in json.loads(file.read_text()).items() if key != "sha256"}
    file.write_bytes(encode({**value, "format_version": f"{int(VERSIONS[-1]) + 1}.0"}))
    with pytest.raises(StoreError, match=r"is newer than .* upgrade presight"):
        PriorReader.open(tmp_path / "store", "town")


@pytest.mark.parametrize("version", VERSIONS)
def test_a_later_minor_version_with_more_names_is_read(tmp_path: Path, version: str):
    shutil.copytree(STORES / version / "store", tmp_path / "store")
    file = tmp_path / "store/town/city.json"
    value = {key: item for key, item in json.loads(file.read_text()).items() if key != "sha256"}
    file.write_bytes(encode({**value, "format_version": f"{version}.7", "new_name": [1, 2]}))
    assert PriorReader.open(tmp_path / "store", "town").channel_count == 8
