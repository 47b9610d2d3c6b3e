"""The wheel holds everything that a user needs, and works away from this repository."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

REPOSITORY = Path(__file__).resolve().parents[1]


def wheel_of(project: Path, folder: Path) -> Path:
    """The contents of a freshly built wheel."""
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(project)]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "unpacked")
    return folder / "unpacked"


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory) -> Path:
    return wheel_of(REPOSITORY, tmp_path_factory.mktemp("wheel"))


@pytest.mark.parametrize(
    "file",
    [
        "presight_core/presets/demo.toml",
        "presight_core/models/tiny/segmentation.onnx",
        "presight_core/models/tiny/features.toml",
        "storage/migrations/upgrade.py",
    ],
)
def test_the_wheel_carries(unpacked, file):
    assert (unpacked / file).is_file()


def test_the_wheel_carries_no_tests(unpacked):
    assert not (unpacked / "tests").exists()


@pytest.mark.parametrize("arguments", [("--help",), ("doctor", "--json")])
def test_the_command_works_from_the_wheel(unpacked, tmp_path, arguments):
    """Started in an empty folder, with the wheel's contents before this repository."""
    environment = {**os.environ, "PYTHONPATH": str(unpacked)}
    code = "import flows, sys; from flows.cli import main; print(flows.__file__, file=sys.stderr); main()"
    command = [sys.executable, "-c", code, *arguments]
    result = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=environment)
    assert result.returncode == 0, result.stderr
    assert str(unpacked) in result.stderr
    assert result.stdout


def test_perceptions_wheel_works_beside_it(unpacked, tmp_path):
    perception = wheel_of(REPOSITORY / "perception", tmp_path / "wheel")
    environment = {**os.environ, "PYTHONPATH": f"{perception}{os.pathsep}{unpacked}"}
    code = "import presight_perception.dataset, presight_perception.metrics as metrics; print(metrics.__file__)"
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=environment)
    assert result.returncode == 0, result.stderr
    assert str(perception) in result.stdout
