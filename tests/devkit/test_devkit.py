"""The official nuScenes devkit, in an environment of its own, judges a synthetic data set."""

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from presight_core.synthetic import load_preset, write_dataset

pytestmark = pytest.mark.slow

HERE = Path(__file__).parent
REQUIREMENTS = HERE / "requirements.txt"
SEED = 0  # its drives turn at a junction and pass parked cars
CITY = "towns.singapore-onenorth"
PRESET = load_preset(
    "ci",
    [
        f"{CITY}.style.size_m=260",  # nine nodes: junctions, crossings, both kinds of street
        f"{CITY}.style.spacing_m=75",
        f"{CITY}.density.vehicles=20",
        "keyframes=10",
        "width_px=160",
        "height_px=90",
        "lidar=true",
    ],
)


def last_words(error: subprocess.CalledProcessError | subprocess.TimeoutExpired) -> str:
    output = error.stderr or ""
    lines = (output.decode() if isinstance(output, bytes) else output).strip().splitlines()
    return next((line for line in reversed(lines) if line.startswith("ERROR")), lines[-1] if lines else str(error))


@pytest.fixture(scope="session")
def devkit_python(pytestconfig: pytest.Config) -> Path:
    """An interpreter with the pinned devkit, kept in pytest's cache until the pins change."""
    if sys.version_info[:2] != (3, 11):
        pytest.skip(f"the devkit's pins are wheels for Python 3.11, this is {sys.version.split()[0]}")
    digest = hashlib.sha256(REQUIREMENTS.read_bytes()).hexdigest()[:12]
    folder = pytestconfig.cache.mkdir("devkit") / digest
    python, finished = folder / "bin" / "python", folder / "finished"
    install = [python, "-m", "pip", "install", "--quiet", "--no-deps", "--only-binary=:all:", "--retries=1"]
    if not finished.exists():
        try:
            for command in ([sys.executable, "-m", "venv", "--clear", folder], [*install, "-r", REQUIREMENTS]):
                subprocess.run(command, check=True, capture_output=True, text=True, timeout=600)
        except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
            pytest.skip(f"the devkit's environment cannot be made: {last_words(error)}")
        finished.touch()
    return python


@pytest.fixture(scope="module")
def report(devkit_python: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the devkit says about a freshly written data set."""
    root = tmp_path_factory.mktemp("judged")
    write_dataset(root, PRESET, SEED)
    command = [devkit_python, "-I", "-W", "ignore", HERE / "check_dataset.py", root, root / "pictures"]
    environment = os.environ | {"MPLCONFIGDIR": str(root / "matplotlib")}
    run = subprocess.run(command, check=False, capture_output=True, text=True, env=environment)
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout.splitlines()[-1]) | {"pictures": root / "pictures"}


def test_the_devkit_loads_every_table_and_image(report: dict[str, Any]):
    tables = report["tables"]
    assert (tables["scenes"], tables["images"]) == (2, 2 * 10 * 6)
    assert tables["boxes"] > 0
    assert tables["fastest_box_mps"] < 20  # town traffic; a broken chain of boxes would leap


def test_boxes_sit_on_the_pixels_of_their_vehicles(report: dict[str, Any]):
    boxes = report["boxes"]
    assert boxes["checked"] >= 10
    assert boxes["hits"] == boxes["checked"]
    assert boxes["overlap"] > 0.75  # of box outline and pixels, in images where a car spans some twenty pixels


def test_the_devkit_draws_samples_and_maps(report: dict[str, Any]):
    names = {"sample.png", "front.png", "layers.png", "centre_lines.png", "map_in_image.png"}
    if report["tables"]["lidar_sweeps"]:
        names |= {"lidar.png", "points.png", "poses.png", "poses_on_map.png"}
        assert report["samples"]["lidar_points_in_image"] > 100
    assert names <= {path.name for path in report["pictures"].iterdir()}


def test_every_layer_of_the_map_has_content(report: dict[str, Any]):
    layers = report["layers"]
    assert all(layers["mask_pixels"].values()), layers["mask_pixels"]
    assert all(layers["records_within"].values()), layers["records_within"]
    assert len(layers["records_within"]) == 11
    assert layers["stop_line_cues"] == [1]  # each knows its traffic light


def test_cars_drive_on_drivable_ground(report: dict[str, Any]):
    layers = report["layers"]
    assert layers["drivable_share"] == layers["on_drivable_share"] == layers["on_segment_share"] == 1


def test_the_closest_lane_lies_under_the_car(report: dict[str, Any]):
    lanes = report["lanes"]
    assert lanes["ego_off_lane_m"][1] < 0.3
    assert lanes["ego_off_lane_rad"][1] < 0.3  # even where lanes part in a junction


def test_lanes_join_smoothly_to_a_network(report: dict[str, Any]):
    lanes = report["lanes"]
    assert lanes["unconnected"] == 0
    assert lanes["joint_gap_m"] < 0.01
    assert lanes["joint_kink_rad"] < 0.01
    assert lanes["middle_error_m"] < 0.3
