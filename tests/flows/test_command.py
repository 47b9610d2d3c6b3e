"""The `presight` command as a user meets it: one clear line, a telling exit code, nothing half done."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

VERSION = "v1.0-mini"


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, with its bytes; databases' side files left out."""
    files = (file for file in folder.rglob("*") if file.is_file())
    return {str(file): file.read_bytes() for file in files if not file.name.endswith(("-wal", "-shm"))}


@pytest.fixture
def workspace(tmp_path, tiny, presight) -> Path:
    """A workspace that one sound data set was ingested into."""
    folder = tmp_path / "workspace"
    result = presight(folder, "ingest", tiny.write(), "--version", VERSION)
    assert result.returncode == 0, result.stderr
    return folder


def remove_root(tiny) -> None:
    tiny.root = tiny.root / "absent"


def truncate_table(tiny) -> None:
    table = tiny.folder / "ego_pose.json"
    table.write_bytes(table.read_bytes()[:-40])


def dangle_token(tiny) -> None:
    tiny.tables["sample_data"][0]["ego_pose_token"] = "nobody"
    tiny.write_tables()


def remove_image(tiny) -> None:
    (tiny.root / tiny.images[0]["filename"]).unlink()


def break_image(tiny) -> None:
    (tiny.root / tiny.images[0]["filename"]).write_bytes(tiny.jpeg[:200])


def spoil_pose(tiny) -> None:
    tiny.tables["ego_pose"][0]["translation"][0] = float("nan")
    tiny.write_tables()


def ask_for_another_version(tiny) -> None:
    tiny.version = "v1.0-trainval"


@pytest.mark.parametrize(
    ("fault", "named"),
    [
        (remove_root, "absent"),
        (truncate_table, "ego_pose.json"),
        (dangle_token, "sample_data.json"),
        (remove_image, ".jpg"),
        (break_image, ".jpg"),
        (spoil_pose, "ego_pose"),
        (ask_for_another_version, "v1.0-trainval"),
    ],
)
def test_bad_input_gets_one_line_and_status_2_and_changes_nothing(workspace, tiny, fault, named, presight):
    before = contents(workspace)
    fault(tiny)
    result = presight(workspace, "ingest", tiny.root, "--version", tiny.version)
    assert result.returncode == 2
    errors = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1
    assert named in result.stderr
    assert "Traceback" not in result.stderr
    assert contents(workspace) == before


def test_keep_going_takes_the_good_frames_of_a_drive_with_a_bad_one(tmp_path, tiny, presight):
    tiny.write()
    remove_image(tiny)
    result = presight(tmp_path / "workspace", "ingest", tiny.root, "--version", VERSION, "--keep-going", "--json")
    assert result.returncode == 0
    drives = json.loads(result.stdout)["drives"]
    assert [drive["frame_count"] for drive in drives] == [7, 8]
    assert [len(drive["rejects"]) for drive in drives] == [1, 0]


def test_keep_going_leaves_out_a_drive_without_good_frames(tmp_path, tiny, presight):
    tiny.write()
    for row in tiny.images:
        if row["sample_token"].startswith("sample-1"):
            (tiny.root / row["filename"]).unlink()
    result = presight(tmp_path / "workspace", "ingest", tiny.root, "--version", VERSION, "--keep-going", "--json")
    answer = json.loads(result.stdout)
    assert [drive["name"] for drive in answer["drives"]] == ["scene-0000"]
    assert answer["left_out"] == 1


def test_ingesting_again_is_a_no_op(workspace, tiny, presight):
    result = presight(workspace, "ingest", tiny.root, "--version", VERSION, "--json")
    assert [drive["new"] for drive in json.loads(result.stdout)["drives"]] == [False, False]


def test_status_lists_a_city_before_anything_is_built(workspace, presight):
    result = presight(workspace, "status", "--json")
    assert json.loads(result.stdout) == {"toytown": []}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("status", "atlantis"), "atlantis: no such city here; known: toytown"),
        (("plan", "atlantis"), "atlantis: no drives"),
        (("plan", "toytown", "--set", "training.stepz=1"), "did you mean steps?"),
        (("query", "toytown", "--at", "1,2"), "--at 1,2: write three numbers"),
        (("query", "toytown", "--at", "1,2,3"), "toytown"),
    ],
)
def test_a_request_that_cannot_be_met_says_why(workspace, arguments, said, presight):
    result = presight(workspace, *arguments)
    assert result.returncode == 2
    assert said in result.stderr
    assert "Traceback" not in result.stderr


def test_a_workspace_that_is_not_one_is_named_and_not_made(tmp_path, presight):
    result = presight(tmp_path / "nowhere", "status")
    assert result.returncode == 2
    assert "presight ingest" in result.stderr
    assert not (tmp_path / "nowhere").exists()


def test_without_the_pipelines_packages_a_command_says_what_to_install(workspace):
    code = "import sys; sys.modules['pyarrow'] = None; from flows.cli import main; main()"
    command = [sys.executable, "-c", code, "--workspace", str(workspace), "plan", "toytown"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 3
    assert "pyarrow" in result.stderr
    assert "pip install" in result.stderr
    assert "Traceback" not in result.stderr


def test_a_plan_names_the_tiles_and_why_they_are_stale(workspace, presight):
    (workspace / "cities").mkdir()
    (workspace / "cities" / "toytown.toml").write_text('preset = "demo"\n')
    plan = json.loads(presight(workspace, "plan", "toytown", "--json").stdout)
    assert plan["drives"] == ["scene-0000", "scene-0001"]
    assert [tile["reasons"] for tile in plan["tiles"]] == [["never built"]]


def test_frames_keep_the_pose_of_their_own_timestamp(workspace):
    from storage.workspace import Workspace

    opened = Workspace.open(workspace)
    frames = opened.drives().frames(opened.catalog().drives("toytown")[0].drive_id)
    front = frames.select(frames.camera == "CAM_FRONT")
    np.testing.assert_allclose(np.diff(front.positions[:, 0]), [0.83, 4.17, 0.83], atol=1e-9)


def test_an_error_of_the_disk_is_one_line_and_status_4(monkeypatch, capsys):
    from flows import cli

    def full() -> None:
        raise OSError(28, "No space left on device", "/somewhere")

    monkeypatch.setattr(cli, "app", full)
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 4
    assert capsys.readouterr().err.startswith("error: [Errno 28] No space left on device: '/somewhere'; check the disk")
