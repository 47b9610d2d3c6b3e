"""`presight features` and `presight models` as a user meets them."""

import json

import numpy as np
from PIL import Image

from tests.tiny_dataset import TinyDataset

VERSION = "v1.0-mini"
CITY = "toytown"


def test_a_space_is_fitted_frozen_and_used_to_show_a_frame(tmp_path, tiny: TinyDataset, presight):
    workspace = tmp_path / "workspace"
    assert presight(workspace, "ingest", tiny.write(), "--version", VERSION).returncode == 0
    drive, *others = json.loads(presight(workspace, "plan", CITY, "--json").stdout)["drives"]

    without = presight(workspace, "features", "show", drive)
    assert without.returncode == 2
    assert f"presight features fit {CITY}" in without.stderr

    fitted = presight(workspace, "features", "fit", CITY, "--json")
    assert fitted.returncode == 0, fitted.stderr
    space = json.loads(fitted.stdout)
    assert space["is_default"]
    assert space["explained"] == sorted(space["explained"], reverse=True)

    again = json.loads(
        presight(workspace, "features", "fit", CITY, "--set", "features.sample_patches=9", "--json").stdout
    )
    assert not again["is_default"]
    assert again["default"] == space["space_id"] != again["space_id"]

    shown = presight(workspace, "features", "show", drive, "--camera", "CAM_FRONT", "--index", "0", "--png")
    assert shown.returncode == 0, shown.stderr
    assert f"of space {space['space_id']}" in shown.stdout
    assert np.asarray(Image.open(shown.stdout.splitlines()[-1])).shape[1] > 1200

    missing = presight(workspace, "features", "show", drive, "--index", "99999")
    assert missing.returncode == 2
    assert "give an index below that" in missing.stderr

    report = presight(workspace, "features", "report", CITY)
    assert f"features of 0 of {1 + len(others)} drives" in report.stdout


def test_an_export_that_cannot_be_names_the_cure(tmp_path, presight):
    wrong = presight(tmp_path, "models", "export", "resnet", "--checkpoint", tmp_path, "--out", tmp_path / "x.onnx")
    assert wrong.returncode == 2
    assert "export segformer or dino" in wrong.stderr
    empty = presight(tmp_path, "models", "export", "dino", "--checkpoint", tmp_path, "--out", tmp_path / "x.onnx")
    assert empty.returncode == 2
    assert "download the whole checkpoint" in empty.stderr
