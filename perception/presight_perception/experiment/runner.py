"""Do an experiment: train what is not trained yet, try what is not tried yet, several runs side by side.

Runs and their figures are kept, so that tables share their work, and a broken-off experiment goes on where it was.
"""

import json
import multiprocessing
import os
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from presight_core.progress import Progress, Report, silent
from presight_perception.experiment.material import Locations, Material
from presight_perception.experiment.runs import Probe, Run, digest
from presight_perception.experiment.tables import Row
from presight_perception.experiment.tasks import Figures, MapTask, task_of
from presight_perception.experiment.trained_models import run_folder, trained_model
from presight_perception.experiment.training import write_whole
from presight_perception.experiment.trial import Trial, constant_mask_figures

SILENT_S = 300.0  # who has said nothing for so long was killed
FIGURES = 3  # raise it when the same model would be given other figures

_material: dict[str, Material] = {}  # of this process, which reads the tables once


@dataclass(frozen=True)
class Job:
    """One training and every probe of it; without a run, the constant mask."""

    run: Run | None
    probes: tuple[Probe, ...]
    locations: Locations
    folder: Path  # of all runs


@dataclass(frozen=True)
class Outcome:
    """The figures of one row, by group of keyframes, percent."""

    row: Row
    figures: dict[str, Figures]


def do_rows(
    rows: Sequence[Row], locations: Locations, folder: Path, parallel: int, report: Report = silent
) -> list[Outcome]:
    """The outcome of every row, in order. Raises what the first failing run raises, after the others have ended."""
    probes: dict[Run | None, dict[Probe, None]] = {}
    for row in rows:
        probes.setdefault(row.run, {})[row.probe] = None
    for teacher in [run.teacher for run in probes if run is not None and run.teacher is not None]:
        probes.setdefault(teacher, {})
    jobs = [Job(run, tuple(tried), locations, folder) for run, tried in probes.items()]
    taught = [job for job in jobs if job.run is not None and job.run.teacher is not None]
    waves = [[job for job in jobs if job not in taught], taught]
    figures: dict[tuple[Run | None, Probe], dict[str, Figures]] = {}
    # Spawned: forked children of a process that has used torch's threads may hang.
    with ProcessPoolExecutor(parallel, multiprocessing.get_context("spawn")) as pool:
        done = 0
        for wave in waves:  # two runs of one teacher must not both train it
            pending = {pool.submit(do_job, job): job for job in wave}
            for future in as_completed(pending):
                job = pending[future]
                figures |= {(job.run, probe): found for probe, found in zip(job.probes, future.result(), strict=True)}
                done += 1
                report(Progress("runs", done, len(jobs)))
    return [Outcome(row, figures[row.run, row.probe]) for row in rows]


def do_job(job: Job) -> list[dict[str, Figures]]:
    """The figures of each probe of one run, trained first if need be. For a process of its own."""
    torch.set_num_threads(1)  # runs side by side make better use of processors than threads within one
    material = material_of(job.locations)
    if job.run is None:
        task = task_of("raster", job.locations)
        assert isinstance(task, MapTask)
        return [constant_mask_figures(task, material) for _ in job.probes]
    folder = run_folder(job.run, material, job.folder)
    task = task_of(job.run.model, job.locations)
    follow = _Follow(folder / "progress.json", job.run)
    model = trained_model(job.run, task, material, job.folder, follow.tell)
    found = []
    for probe in job.probes:
        file = folder / f"figures-{digest(FIGURES, probe, job.locations.test_stride)}.json"
        if not file.exists():
            figures = Trial(model, job.run, probe, task, material).figures(follow.tell)
            _write_json(file, {"probe": asdict(probe), "figures": figures})
        found.append(json.loads(file.read_text(encoding="utf-8"))["figures"])
    follow.end()
    return found


def material_of(locations: Locations) -> Material:
    """The material at some locations, read once in each process."""
    key = digest({name: str(value) for name, value in asdict(locations).items()})
    if key not in _material:
        _material[key] = Material(locations)
    return _material[key]


class _Follow:
    """Leaves word of a run's progress in a file, for whoever watches."""

    def __init__(self, file: Path, run: Run) -> None:
        self._file, self._run = file, run

    def tell(self, progress: Progress) -> None:
        parent = multiprocessing.parent_process()
        if parent is not None and not parent.is_alive():
            # Killed: nobody waits, and a new experiment may be at this run. The pool would catch an exception.
            os._exit(1)
        self._file.parent.mkdir(parents=True, exist_ok=True)
        _write_json(self._file, asdict(progress))

    def end(self) -> None:
        self._file.unlink(missing_ok=True)


def running(folder: Path) -> list[Progress]:
    """How far the runs in a folder are that are at work."""
    found = []
    for file in sorted(folder.glob("*/progress.json")):
        try:
            if time.time() - file.stat().st_mtime > SILENT_S:
                continue
            found.append(Progress(**json.loads(file.read_text(encoding="utf-8"))))
        except (OSError, ValueError):  # it has just ended, or been replaced
            continue
    return found


def _write_json(file: Path, value: Any) -> None:
    write_whole(file, lambda part: part.write_text(json.dumps(value, indent=1), encoding="utf-8"))
