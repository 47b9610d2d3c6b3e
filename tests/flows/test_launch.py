"""The parent's side of a worker: results, progress, errors and deaths come through."""

import subprocess
import sys
from dataclasses import replace

import pytest

from flows import launch
from flows.jobs import Job
from presight_core.errors import BuildError, ConflictError, InputError
from presight_core.progress import Progress
from presight_core.tiles import Tile, Tiling
from storage.workspace import Workspace

JOB = Job(workspace="nowhere", city="toytown", build_id=1, settings={})


def speak(monkeypatch: pytest.MonkeyPatch, script: str) -> None:
    """Let a Python script stand for the worker."""
    monkeypatch.setattr(launch, "WORKER", (sys.executable, "-c", script))


def test_a_result_comes_back(monkeypatch):
    speak(monkeypatch, """print('{"result": {"voxels": 7}}')""")
    assert launch.run_job("train", JOB) == {"voxels": 7}


def test_progress_is_passed_on_and_other_output_is_not(monkeypatch):
    moment = '{"progress": {"stage": "training", "done": 1, "total": 2, "figures": {"loss": 0.5}}}'
    speak(monkeypatch, f"""print('hello'); print('{moment}'); print('{{"result": {{}}}}')""")
    heard: list[Progress] = []
    launch.run_job("train", JOB, heard.append)
    assert heard == [Progress("training", 1, 2, {"loss": 0.5})]


def test_an_error_of_ours_keeps_its_type_and_message(monkeypatch):
    speak(monkeypatch, """print('{"error": {"name": "InputError", "message": "image 7 is torn"}}')""")
    with pytest.raises(InputError, match="image 7 is torn"):
        launch.run_job("train", JOB)


def test_an_unforeseen_error_becomes_a_build_error_that_names_it(monkeypatch):
    speak(monkeypatch, """print('{"error": {"name": "ZeroDivisionError", "message": "by zero"}}')""")
    with pytest.raises(BuildError, match="ZeroDivisionError: by zero"):
        launch.run_job("train", JOB)


def test_a_job_reaches_its_worker_however_large_the_city(monkeypatch):
    speak(
        monkeypatch, """import json; print(json.dumps({"result": {"drives": len(json.loads(input())["drive_ids"])}}))"""
    )
    drives = tuple(f"{number:016x}" for number in range(50_000))  # a megabyte; an argument holds an eighth of that
    assert launch.run_job("train", replace(JOB, drive_ids=drives)) == {"drives": 50_000}


def test_a_worker_that_ends_before_it_reads_its_job_is_lost_with_its_last_words(monkeypatch):
    speak(monkeypatch, "raise SystemExit('no such partition')")
    with pytest.raises(launch.WorkerLostError, match="no such partition"):
        launch.run_job("train", replace(JOB, drive_ids=("long",) * 100_000))


def test_a_killed_worker_is_lost_and_its_last_words_are_kept(monkeypatch):
    speak(monkeypatch, "import os; print('so far so good', flush=True); os.kill(os.getpid(), 9)")
    with pytest.raises(launch.WorkerLostError, match=r"status -9[\s\S]*so far so good"):
        launch.run_job("train", JOB)


def test_a_name_from_outside_the_error_tree_is_never_called(monkeypatch):
    speak(monkeypatch, """print('{"error": {"name": "__builtins__", "message": "x"}}')""")
    with pytest.raises(BuildError, match="__builtins__: x"):
        launch.run_job("train", JOB)


def test_a_worker_ends_when_its_parent_dies():
    """The worker is started with a pipe for standard input; closing it is what a dying parent does."""
    script = (
        "import flows.worker as worker, threading, time\n"
        "threading.Thread(target=worker._end_with_parent, daemon=True).start()\n"
        "time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE) as process:
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(timeout=30) == 137


def test_a_job_survives_its_text():
    job = Job("w", "c", 3, {"preset": "demo"}, drive_ids=("a", "b"), recipe={"stage": "tile"})
    assert Job.from_json(job.to_json()) == job


def test_a_job_knows_the_tiling_that_it_was_made_for_and_refuses_another(tmp_path):
    tiling = Tiling("first", "toytown", (Tile("t000", (1.0, 2.0)), Tile("t001", (0.1, 1 / 3))))
    workspace = Workspace.open(tmp_path)
    workspace.catalog().save_tiling(tiling, {})
    job = replace(JOB, workspace=str(tmp_path), tiling_id="first", tile=1, tile_id="t001")
    assert job.opened_tiling == tiling
    workspace.catalog().save_tiling(replace(tiling, tiling_id="second"), {})
    with pytest.raises(ConflictError, match="toytown: its tiles were cut anew"):
        _ = job.opened_tiling
