"""The promises of the layout: which packages these are, what may import what, and how fast the command starts."""

import subprocess
import sys
from pathlib import Path

import pytest

import flows
import presight_core
import stages
import storage

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize("package", [flows, presight_core, stages, storage])
def test_the_packages_are_this_projects_own(package):
    """PyPI has packages named storage, flows and stages."""
    assert Path(package.__file__).parent.parent == REPOSITORY


def loaded_modules(statement: str) -> set[str]:
    code = f"import sys\n{statement}\nprint('\\n'.join(sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=REPOSITORY)
    return set(result.stdout.split())


@pytest.mark.parametrize(
    "module", ["torch", "prefect", "zarr", "sqlalchemy", "pydantic", "sklearn", "onnxruntime", "cv2"]
)
def test_reading_priors_does_not_import(module):
    assert module not in loaded_modules("import presight_core.priors.reader")


@pytest.mark.parametrize("module", ["torch", "prefect", "zarr", "numba", "sklearn", "onnxruntime", "cv2"])
def test_the_command_line_does_not_import_until_needed(module):
    assert module not in loaded_modules("import flows.cli")


def test_no_unsafe_deserialisation_anywhere():
    sources = [
        file
        for folder in ("presight_core", "storage", "stages", "flows", "perception/presight_perception")
        for file in (REPOSITORY / folder).rglob("*.py")
    ]
    assert sources
    offenders = [
        file.name
        for file in sources
        for word in ("import pickle", "from pickle", "torch.load(", "yaml.load(", "allow_pickle=True")
        if word in file.read_text()
    ]
    assert offenders == ["legacy.py"]  # the released project's pickles, through an unpickler that knows arrays only
