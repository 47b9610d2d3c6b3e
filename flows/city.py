"""The flows `rebuild_city` and `update_city`: what is stale of one city, tiles in parallel, one generation."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from prefect import flow

from flows import tasks
from flows.jobs import Job
from flows.machines import Crew, asking, is_on_cluster
from flows.plan import CityPlan, plan_city, record_plan
from flows.publication import Built, publish
from flows.reconcile import hold_city
from presight_core.config import load_city_settings
from presight_core.recipes import Recipe
from storage.leases import Lease
from storage.restoration import remember_tiling
from storage.tile_states import CITY_ROW
from storage.workspace import Workspace


@dataclass(frozen=True)
class Order:
    """What one run shall do: references only."""

    workspace: str
    city: str
    overrides: Sequence[str] = ()
    threads: int = 1  # of each tile
    devices: Sequence[str] = ("cpu",)
    wait: bool = False  # while another run builds the city
    accept: Sequence[str] = ()  # tiles, by name or pattern, that may differ from their old build as they like
    warm: bool = False  # go on from the fields that tiles have, where their recipes allow it


def run_city(order: Order, crew: Crew) -> dict[str, Any]:
    """Run the flow with this crew: what it published, and the tiles that failed, with why.

    A tile that fails keeps its old build. While another run builds the city this one waits, or raises LeaseHeldError.
    """
    verb = "update" if order.warm else "rebuild"
    run = bring_city_up_to_date.with_options(
        name=f"{verb}_city", flow_run_name=f"{verb} {order.city}", task_runner=crew.task_runner
    )
    return run(replace(order, threads=crew.threads, devices=crew.devices))


@flow(persist_result=False)
def bring_city_up_to_date(order: Order) -> dict[str, Any]:
    """Build what is stale, and publish it."""
    opened = Workspace.open(Path(order.workspace))
    settings = load_city_settings(opened.city_file(order.city), order.overrides)
    with hold_city(opened, order.city, order.wait) as lease:
        plan = plan_city(opened, order.city, settings)
        if plan.stale and plan.space_id is None:
            _fit_space(opened, plan, order.threads, lease)
            plan = plan_city(opened, order.city, settings)
        record_plan(opened, plan)
        if plan.is_current:
            return {"generation": plan.generation, "published": [], "failed": {}, "withdrawn": {}}
        if not plan.stale:
            return publish(opened, plan, [], {}, lease)
        freeze(opened, plan, lease)
        with asking(settings.resources):
            broken = _extract_features(opened, plan, order.threads, lease)
            built, failed = _build_tiles(tile_jobs(opened, plan, order, lease), broken)
        return publish(opened, plan, built, failed, lease, order.accept)


def freeze(workspace: Workspace, plan: CityPlan, lease: Lease) -> None:
    """Fix what every later build of the city must share: its tiling, its lattice and its feature space."""
    assert plan.space_id is not None
    workspace.catalog().save_tiling(plan.tiling, plan.settings.tiling.model_dump(mode="json"))
    channels = workspace.artifacts().space(plan.space_id).channel_count
    workspace.store().create_city(plan.city, plan.lattice, plan.space_id, channels)
    remember_tiling(workspace.store(), workspace.catalog(), plan.tiling)
    if lease.follows_lost:  # when the lease was taken the store may not have known the city
        workspace.store().raise_fence(plan.city, lease.token)


def _fit_space(workspace: Workspace, plan: CityPlan, threads: int, lease: Lease) -> None:
    catalog = workspace.catalog()
    drive_ids = tuple(drive.drive_id for drive in plan.drives)
    recipe = Recipe("space", 1, {}, {"drives": list(drive_ids)})
    build_id = catalog.start_build(plan.city, CITY_ROW, recipe, lease)
    try:
        tasks.fit_space(replace(_job(workspace, plan, build_id, threads), drive_ids=drive_ids))
    except Exception as error:
        catalog.finish_build(build_id, "failed", {}, str(error))
        raise
    catalog.finish_build(build_id, "built", {})


def _extract_features(workspace: Workspace, plan: CityPlan, threads: int, lease: Lease) -> dict[str, str]:
    """Features of every drive that a stale tile needs; the error of each drive that has none, by drive id."""
    assert plan.features is not None
    cache, catalog = workspace.features(), workspace.catalog()
    needed = sorted({drive_id for tile in plan.stale for drive_id in tile.drive_ids})
    missing = [drive_id for drive_id in needed if not cache.is_complete(plan.features.digest, drive_id)]
    if not missing:
        return {}
    build_id = catalog.start_build(plan.city, CITY_ROW, plan.features, lease)
    job = _job(workspace, plan, build_id, threads)
    ends: dict[str, Callable[[], Any]] = {}
    for drive_id in missing:
        of_drive = replace(job, drive_ids=(drive_id,))
        # Here one after the other: a session uses all threads, and the disk is the limit. On a cluster all at once.
        spread = tasks.extract_features.submit(of_drive).result if is_on_cluster() else None
        ends[drive_id] = spread or partial(tasks.extract_features, of_drive)
    broken: dict[str, str] = {}
    for drive_id, end in ends.items():
        try:
            end()
        except Exception as error:  # it must not sink the tiles that do without the drive
            broken[drive_id] = str(error)
    catalog.finish_build(build_id, "failed" if broken else "built", {}, "; ".join(broken.values()))
    return broken


def tile_jobs(workspace: Workspace, plan: CityPlan, order: Order, lease: Lease) -> dict[str, Job]:
    """A job for every stale tile, each with a row in the catalog."""
    jobs = {}
    for index, tile in enumerate(plan.stale):
        training, whole = tile.recipes(order.warm)
        build_id = workspace.catalog().start_build(plan.city, tile.tile_id, whole, lease)
        jobs[tile.tile_id] = replace(
            _job(workspace, plan, build_id, order.threads),
            device=order.devices[index % len(order.devices)],
            drive_ids=tile.drive_ids,
            tile=tile.tile,
            tile_id=tile.tile_id,
            training_recipe=training.to_json(),
            recipe=whole.to_json(),
        )
    return jobs


def _job(workspace: Workspace, plan: CityPlan, build_id: int, threads: int) -> Job:
    return Job(
        workspace=str(workspace.root),
        city=plan.city,
        build_id=build_id,
        settings=plan.settings.model_dump(mode="json"),
        threads=threads,
        space_id=plan.space_id or "",
        features_recipe=plan.features.to_json() if plan.features else {},
        tiling_id=plan.tiling.tiling_id,
    )


def _build_tiles(jobs: dict[str, Job], broken: dict[str, str]) -> tuple[list[Built], dict[str, tuple[Job, str]]]:
    """Train and extract all tiles in parallel: what was built, and the job and error of each tile that was not."""
    failed = {
        tile_id: (job, next(broken[drive_id] for drive_id in job.drive_ids if drive_id in broken))
        for tile_id, job in jobs.items()
        if broken.keys() & set(job.drive_ids)
    }
    trained = {tile_id: tasks.train_tile.submit(job) for tile_id, job in jobs.items() if tile_id not in failed}
    # Extractions queue behind all trainings, so that none holds a thread while it waits for its field.
    extract: Any = tasks.extract_tile  # Prefect's overloads of `submit` know no `wait_for` here
    extracted = {tile_id: extract.submit(jobs[tile_id], wait_for=[future]) for tile_id, future in trained.items()}
    built = []
    for tile_id, future in trained.items():
        try:
            built.append(Built(jobs[tile_id], future.result(), extracted[tile_id].result()))
        except Exception as error:  # whatever it was, it must not sink the other tiles
            failed[tile_id] = (jobs[tile_id], f"{type(error).__name__}: {error}")
    return built, failed
