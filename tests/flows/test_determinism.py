"""Row R15 of docs/reliability.md with trained fields: how a city is built does not show in its priors, not by one bit.

One thread a worker: how the sums of a layer are cut depends on the number of threads (docs/reliability.md).
"""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from presight_core.synthetic import write_dataset
from storage.workspace import Workspace
from tests.stages.small_training import TINY

pytestmark = pytest.mark.slow

CITY = "singapore-onenorth"
OVERRIDES = (
    *TINY, "training.steps=60", "training.checkpoint_every=5",
    "tiling.tile_count=4", "tiling.sub_field_count=1", "extraction.surface=first-hit", "extraction.fog_density=0.0",
    "extraction.min_density=0.0", "extraction.max_depth_m=900.0", "extraction.below_camera_m=500.0",
    "extraction.above_camera_m=500.0", "extraction.pixel_stride=16", "validation.min_voxels=1",
    "validation.min_psnr_db=1.0",
)  # fmt: skip
ENDINGS = (0, 6)  # 6: a field of so few steps may leave a tile without voxels, which is then not published
PATIENCE_S = 600


@pytest.fixture(scope="module")
def one_core() -> Iterator[None]:
    """Children see one core, so that every worker gets one thread, however many there are."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    yield
    os.sched_setaffinity(0, cores)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, one_core) -> Path:
    """A workspace whose city was built by one worker at a time, without a break."""
    folder = tmp_path_factory.mktemp("determinism")
    write_dataset(folder / "data", "ci", seed=0)
    (folder / "whole" / "cities").mkdir(parents=True)
    (folder / "whole" / "cities" / f"{CITY}.toml").write_text('preset = "demo"\n')
    ingest(folder / "whole")
    assert build(folder / "whole", 1).wait(PATIENCE_S) in ENDINGS
    return folder / "whole"


def start(workspace: Path, *arguments: str) -> subprocess.Popen:
    """The command, as the leader of its processes."""
    command = [sys.executable, "-m", "flows.cli", "--workspace", str(workspace), *arguments]
    environment = {**os.environ, "PREFECT_HOME": str(workspace.parent / "prefect")}
    with (workspace / "log").open("ab") as log:
        return subprocess.Popen(command, stdout=log, stderr=log, env=environment, start_new_session=True)


def ingest(workspace: Path) -> None:
    assert start(workspace, "ingest", str(workspace.parent / "data"), "--version", "v1.0-mini").wait(PATIENCE_S) == 0


def build(workspace: Path, workers: int) -> subprocess.Popen:
    overrides = [part for override in OVERRIDES for part in ("--set", override)]
    return start(workspace, "build", CITY, "--parallel", str(workers), *overrides)


def fresh(whole: Path, name: str) -> Path:
    """A workspace with the same drives, features and feature space, and nothing built."""
    made = Path(shutil.copytree(whole, whole.parent / name, ignore=shutil.ignore_patterns("store", "scratch", "cat*")))
    ingest(made)
    return made


def digests(workspace: Path) -> dict[str, str]:
    """Of every tile that is shown."""
    generation = Workspace.open(workspace).store().generation(CITY)
    assert generation is not None, (workspace / "log").read_text()
    assert len(generation.tiles) >= 3
    assert all(tile.entry.voxel_count for tile in generation.tiles.values())
    return {tile_id: tile.entry.digest for tile_id, tile in generation.tiles.items()}


def test_four_workers_killed_and_resumed_give_the_bits_of_one_undisturbed(whole):
    killed = fresh(whole, "killed")
    run = build(killed, 4)
    until(lambda: any(killed.rglob("training.safetensors")), run)
    os.killpg(run.pid, signal.SIGKILL)  # the command, and the workers in the middle of their trainings
    run.wait()
    assert not any(killed.rglob("training.json")), "it was killed too late: a tile was trained"
    assert build(killed, 4).wait(PATIENCE_S) in ENDINGS
    assert digests(killed) == digests(whole)


def until(is_so, run: subprocess.Popen) -> None:
    """Wait for something while a run is at work."""
    deadline = time.monotonic() + PATIENCE_S
    while not is_so():
        assert run.poll() is None, "it ended before it could be killed"
        assert time.monotonic() < deadline, "nothing happens"
        time.sleep(0.01)
