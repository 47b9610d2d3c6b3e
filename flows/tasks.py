"""The Prefect tasks: a stage of a tile or a drive each. They give order and retries; workers do the arithmetic.

Parameters and results are references and small figures (JSON), never arrays.
"""

from dataclasses import replace
from typing import Any

from prefect import task
from prefect.cache_policies import NO_CACHE

from flows.jobs import Job
from flows.launch import WorkerLostError, run_job
from flows.pace import Pace
from presight_core.errors import BuildError, ConflictError
from presight_core.progress import Progress
from storage.catalog import Build
from storage.tile_states import CITY_ROW


def only_time_can_cure(_task: Any, _run: Any, state: Any) -> bool:
    """Whether a failure may pass by itself: a lost race or a killed worker, never bad data or settings."""
    return isinstance(getattr(state.data, "result", state.data), WorkerLostError | ConflictError)


QUEUED = Progress("", 0, 0)  # nobody works on it

# The catalog holds the truth, so Prefect neither caches nor persists results. No task has tags: one that has asks the
# server for leave before it starts, and a run that has begun shall go on without its server.
OPTIONS: dict[str, Any] = {
    "cache_policy": NO_CACHE,
    "persist_result": False,
    "retries": 1,
    "retry_condition_fn": only_time_can_cure,
}


@task(name="fit-space", **OPTIONS)
def fit_space(job: Job) -> dict[str, Any]:
    """Fit and freeze the feature space of the job's models."""
    return _work("fit-space", job)


@task(name="extract-features", task_run_name="features of {job.drive_ids[0]}", **OPTIONS)
def extract_features(job: Job) -> dict[str, Any]:
    """Label maps and features of one drive, into the cache."""
    return _work("features", job)


@task(name="train-tile", task_run_name="train {job.tile_id}", **OPTIONS)
def train_tile(job: Job) -> dict[str, Any]:
    """Train and evaluate one tile's field."""
    trained = _work("train", job)
    job.opened_workspace.catalog().progress(job.build_id, QUEUED)  # until its extraction has its turn
    return trained


@task(name="extract-tile", task_run_name="extract {job.tile_id}", **OPTIONS)
def extract_tile(job: Job) -> dict[str, Any]:
    """Turn one tile's field into voxels, written but not yet published."""
    return _work("extract", job)


def _work(command: str, job: Job) -> dict[str, Any]:
    """Run a job and let the catalog know how far it is, and how many workers died at it before."""
    catalog = job.opened_workspace.catalog()
    given_up = BuildError(f"{command}: somebody ended build {job.build_id} in the catalog; its work is given up")
    row = next((build for build in catalog.running(job.city) if build.build_id == job.build_id), None)
    if row is None:
        raise given_up
    lost = _lost_workers(row)

    def report(progress: Progress) -> None:
        if not catalog.progress(job.build_id, replace(progress, figures={**progress.figures, **lost})):
            raise given_up

    return {**run_job(command, job, Pace(report)), **lost}


def _lost_workers(row: Build) -> dict[str, float]:
    """Their number, if there are any: a tile's row that nobody works on has no stage."""
    if row.tile_id == CITY_ROW or row.stage == QUEUED.stage:
        return {}
    return {"lost_workers": row.figures.get("lost_workers", 0) + 1}
