"""Which machines build a city's tiles: threads of this one, or the workers of a Dask cluster (docs/schedules.md)."""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

from flows.prefect_settings import require_server
from presight_core.config import ResourceSettings
from presight_core.errors import MissingDependencyError, SettingsError

RUNNERS = ("threads", "dask")
CLUSTER_START_S = 30  # a scheduler that does not answer by then is taken to be down


@dataclass(frozen=True)
class Machines:
    """What a user wants tiles to be built on. Raises SettingsError for what cannot be meant."""

    runner: str = "threads"
    cluster: str = ""  # address of its scheduler
    parallel: int | None = None  # tiles at once on this machine; None: as many as it has GPUs, or else cores

    def __post_init__(self) -> None:
        if self.runner not in RUNNERS:
            raise SettingsError(f"--runner {self.runner}: there are {', '.join(RUNNERS)}")
        if (self.runner == "dask") != bool(self.cluster):
            raise SettingsError("--runner dask and --cluster go together: name the scheduler, tcp://HOST:8786")


HERE = Machines()


@dataclass(frozen=True)
class Crew:
    """Who does the jobs of a run, and what each job may use."""

    task_runner: Any  # Prefect's own types of task runners do not fit each other
    threads: int
    devices: tuple[str, ...]  # tiles take them in turn


def crew_of(machines: Machines, resources: ResourceSettings, stale_count: int) -> Crew:
    """The crew that builds so many tiles. Raises SettingsError if the cluster is not there or can never do it."""
    if machines.runner == "threads":
        return _threads_crew(machines.parallel, stale_count)
    if find_spec("prefect_dask") is None:
        raise MissingDependencyError("--runner dask needs the extra: pip install 'presight[pipeline,dask]'")
    require_server()  # one that every worker reaches; without it each of them starts one of its own, in half a minute
    from prefect_dask.task_runners import DaskTaskRunner

    _require_able(machines.cluster, asked(resources))
    # A worker of a cluster sees one GPU, its own, as the first.
    return Crew(DaskTaskRunner(address=machines.cluster), resources.cores, ("cuda:0",) if resources.gpus else ("cpu",))


def available_devices() -> tuple[str, ...]:
    """The GPUs of this machine, or else its processor."""
    import torch

    return tuple(f"cuda:{index}" for index in range(torch.cuda.device_count())) or ("cpu",)


def asked(resources: ResourceSettings) -> dict[str, float]:
    """What a job of a tile asks of a Dask worker, which says what it has: `--resources "CPU=16 GPU=1 MEMORY=64"`."""
    wanted = {"CPU": resources.cores, "GPU": resources.gpus, "MEMORY": resources.memory_gib}
    return {name: count for name, count in wanted.items() if count}


@contextmanager
def asking(resources: ResourceSettings) -> Iterator[None]:
    """What is submitted in this block waits for a worker that has what a tile needs; threads have no such bounds."""
    if not is_on_cluster():
        yield
        return
    from dask.base import annotate

    with annotate(resources=asked(resources)):
        yield


def is_on_cluster() -> bool:
    """Whether the flow that runs here gives its tasks to other machines."""
    from prefect.context import FlowRunContext
    from prefect.task_runners import ThreadPoolTaskRunner

    context = FlowRunContext.get()
    return context is not None and not isinstance(context.task_runner, ThreadPoolTaskRunner)


def _threads_crew(parallel: int | None, stale_count: int) -> Crew:
    from prefect.task_runners import ThreadPoolTaskRunner

    devices, cores = available_devices(), len(os.sched_getaffinity(0))
    wanted = parallel or (cores if devices == ("cpu",) else len(devices))
    at_once = max(1, min(wanted, stale_count))
    return Crew(ThreadPoolTaskRunner(max_workers=at_once), max(1, cores // at_once), devices)


def _require_able(cluster: str, wanted: Mapping[str, float]) -> None:
    """Raise SettingsError unless a worker has all that a tile asks for: Dask itself would wait for ever."""
    from distributed import Client

    try:
        with Client(cluster, timeout=CLUSTER_START_S, set_as_default=False) as client:
            workers = client.scheduler_info(n_workers=-1)["workers"]
    except (OSError, ValueError) as error:
        cure = "start one with `dask scheduler`, or correct --cluster"
        raise SettingsError(f"{cluster}: no Dask scheduler answers there ({error}); {cure}") from error
    offers = [worker["resources"] for worker in workers.values()]
    if not any(all(offer.get(name, 0) >= count for name, count in wanted.items()) for offer in offers):
        text = " ".join(f"{name}={count:g}" for name, count in wanted.items())
        raise SettingsError(
            f"{cluster}: none of its {len(offers)} workers offers what a tile asks for; start workers with "
            f"--resources '{text}' at least, or lower [resources] in the city's TOML"
        )
