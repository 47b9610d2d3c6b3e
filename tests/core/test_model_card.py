"""Model cards: every way a card or its file can be wrong has its own message."""

import hashlib
from pathlib import Path

import pytest

from presight_core.errors import InputError, SettingsError
from presight_core.model_card import ModelCard

MODEL = b"any bytes"
CARD = f"""
name = "test"
kind = "features"
file = "model.onnx"
sha256 = "{hashlib.sha256(MODEL).hexdigest()}"
input = "image"
input_height_px = 32
input_width_px = 48
mean = [0.4, 0.5, 0.6]
std = [0.2, 0.2, 0.2]
output = "features"
layout = "NCHW"
stride = 4
channels = 8
licence = "Apache-2.0"
source = "made by the test"
"""


@pytest.fixture
def card_file(tmp_path: Path) -> Path:
    (tmp_path / "model.onnx").write_bytes(MODEL)
    file = tmp_path / "features.toml"
    file.write_text(CARD)
    return file


def change(file: Path, old: str, new: str) -> str:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))
    return str(file)


def test_a_card_is_found_by_its_path_and_by_its_folder(card_file):
    assert ModelCard.load(str(card_file), "features") == ModelCard.load(str(card_file.parent), "features")


def test_a_card_knows_its_output_grid(card_file):
    card = ModelCard.load(str(card_file), "features")
    assert (card.rows, card.columns) == (8, 12)


def test_the_identity_leaves_out_where_the_model_lies(card_file):
    identity = ModelCard.load(str(card_file), "features").identity
    assert identity["mean"] == [0.4, 0.5, 0.6]
    assert str(card_file.parent) not in str(identity)


def test_an_unknown_name_is_refused():
    with pytest.raises(SettingsError, match="'tinny' does not come with PreSight"):
        ModelCard.load("tinny", "features")


def test_a_missing_card_is_refused(tmp_path):
    with pytest.raises(SettingsError, match=r"absent\.toml"):
        ModelCard.load(str(tmp_path / "absent.toml"), "features")


def test_a_card_of_the_other_kind_is_refused(card_file):
    with pytest.raises(SettingsError, match="this is a features model"):
        ModelCard.load(str(card_file), "segmentation")


def test_a_misspelt_field_names_the_file_and_the_field(card_file):
    path = change(card_file, "stride", "strides")
    with pytest.raises(SettingsError, match=r"features\.toml: .*strides: unknown setting; did you mean stride\?"):
        ModelCard.load(path, "features")


def test_a_model_in_another_folder_is_refused(card_file):
    path = change(card_file, "model.onnx", "../model.onnx")
    with pytest.raises(SettingsError, match="not a plain file name"):
        ModelCard.load(path, "features")


def test_an_input_that_is_no_whole_number_of_strides_is_refused(card_file):
    path = change(card_file, "input_height_px = 32", "input_height_px = 33")
    with pytest.raises(SettingsError, match="33 x 48 px is not a whole number of strides"):
        ModelCard.load(path, "features")


def test_a_deviation_of_zero_is_refused(card_file):
    path = change(card_file, "std = [0.2, 0.2, 0.2]", "std = [0.2, 0.0, 0.2]")
    with pytest.raises(SettingsError, match=r"std: .*greater than 0"):
        ModelCard.load(path, "features")


def test_a_segmentation_model_must_give_the_cityscapes_classes(card_file):
    path = change(card_file, 'kind = "features"', 'kind = "segmentation"')
    with pytest.raises(SettingsError, match="gives 19 classes"):
        ModelCard.load(path, "segmentation")


def test_a_missing_model_is_refused(card_file):
    (card_file.parent / "model.onnx").unlink()
    with pytest.raises(InputError, match=r"model\.onnx: No such file"):
        ModelCard.load(str(card_file), "features")


def test_a_model_with_another_hash_is_refused(card_file):
    (card_file.parent / "model.onnx").write_bytes(MODEL + b"!")
    with pytest.raises(InputError, match="SHA-256 is"):
        ModelCard.load(str(card_file), "features")


def test_a_shipped_model_is_found_where_a_folder_has_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "tiny").mkdir()
    monkeypatch.chdir(tmp_path)
    assert ModelCard.load("tiny", "features").name == "tiny-features"
