"""`presight-perception experiment`: a table's rows done, shown while they run, and written down."""

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bars
from rich.table import Table

from presight_core.errors import InputError
from presight_core.progress import Report, silent
from presight_perception.experiment.material import WITHOUT_VOXELS, Locations, Material, spread
from presight_perception.experiment.pictures import (
    Panel,
    found_picture,
    front_camera,
    prior_picture,
    true_picture,
    write_strip,
)
from presight_perception.experiment.report import table_of, write_report
from presight_perception.experiment.runner import Outcome, do_rows, running
from presight_perception.experiment.runs import ModelName, Probe, Run, Schedule
from presight_perception.experiment.tables import Row, Scope, rows_of
from presight_perception.experiment.tasks import task_of
from presight_perception.experiment.trained_models import trained_model
from presight_perception.experiment.trial import Trial

STRIPS = 6  # pictures of a report
LOOK_S = 0.5  # between two looks at the runs' progress


@dataclass(frozen=True)
class ExperimentOrder:
    """What the command was asked for."""

    name: str
    data: Path
    version: str
    store: str
    colours_store: str | None
    out: Path
    model: str | None
    seeds: int
    steps: int
    test_stride: int
    parallel: int


def run_experiment(order: ExperimentOrder) -> Path:
    """The page with the results. Raises InputError for an unknown experiment or model, and for unusable data."""
    if order.model is not None and order.model not in get_args(ModelName):
        raise InputError(f"no model is named {order.model!r}; choose one of: {', '.join(get_args(ModelName))}")
    locations = Locations(
        order.data, order.version, order.store, test_stride=order.test_stride, colours_store=order.colours_store
    )
    model: ModelName | None = order.model  # pyright: ignore[reportAssignmentType] - checked above
    scope = Scope(order.seeds, Schedule(order.steps), model, colours=order.colours_store is not None)
    rows = rows_of(order.name, scope)
    runs = order.out / "runs"
    with _bars(runs) as report:
        outcomes = do_rows(rows, locations, runs, order.parallel, report)
    material = Material(locations)
    folder = order.out / "-".join([order.name, *([order.model] if order.model else [])])
    folder.mkdir(parents=True, exist_ok=True)
    pictures = write_pictures(rows, material, runs, folder)
    page = write_report(order.name, outcomes, pictures, _facts(material, scope), folder)
    _print(order.name, outcomes)
    return page


def write_pictures(rows: Sequence[Row], material: Material, runs: Path, folder: Path) -> list[Path]:
    """Strips of some test keyframes: the front camera, truth, what the first runs without and with prior found."""
    shown = _shown(rows)
    if not shown:
        return []
    task = task_of(shown[0].model, material.locations)
    models = [trained_model(run, task, material, runs, silent) for run in shown]
    trials = [Trial(model, run, Probe(), task, material) for model, run in zip(models, shown, strict=True)]
    files = []
    for row in spread(material.test, STRIPS):
        keyframe = material.test[row]
        panels = [
            Panel(f"{keyframe.scene}, {keyframe.description}", front_camera(keyframe)),
            Panel("truth", true_picture(task, models[0], keyframe)),
        ]
        for run, model, trial in zip(shown, models, trials, strict=True):
            caption = "without prior" if run.prior == "none" else f"with prior ({run.prior})"
            panels.append(Panel(caption, found_picture(task, model, trial.found([row])[0], keyframe)))
        if shown[-1].prior not in WITHOUT_VOXELS:
            panels.append(Panel("prior", prior_picture(trials[-1].prior([row]), task.prior_grid)))
        files.append(folder / f"{len(files)}-{keyframe.scene}.png")
        write_strip(files[-1], panels)
    return files


def _shown(rows: Sequence[Row]) -> list[Run]:
    """The first run without and the first with prior, of the first model."""
    runs = [row.run for row in rows if row.run is not None and row.run.cameras]
    runs = [run for run in runs if run.model == runs[0].model]
    without = [run for run in runs if run.prior == "none"][:1]
    return without + [run for run in runs if run.prior != "none"][-1:]


def _facts(material: Material, scope: Scope) -> dict:
    """What a reader of the figures must know."""
    return {
        "training keyframes": len(material.train),
        "test keyframes": len(material.test),
        "cities trained in": sorted({keyframe.city for keyframe in material.train}),
        "cities tested in": sorted({keyframe.city for keyframe in material.test}),
        "prior generations": material.priors.generations,
        "feature space": material.priors.space_id,
        "steps": scope.schedule.steps,
        "disturbed in training": str(Run("raster").drop) + " " + str(Run("raster").noise),
        "stream and maptr": "decoders that learn on the bird's-eye view of the raster mapper with the same senses and "
        f"seed, which they keep; {scope.lines_schedule.steps} steps",
        "spread": "standard deviation over seeds",
        "frames/s": "of one processor core's own time: a window of the prior read, voxelised, the model, its output "
        "decoded; images were decoded before",
        "features of the prior": "those of its feature space; of the shipped tiny networks they were learned with the "
        "embedded city's own classes, which flatters them",
    }


def _print(name: str, outcomes: Sequence[Outcome]) -> None:
    columns, lines = table_of(outcomes)
    table = Table(title=name, title_justify="left")
    for number, column in enumerate(columns):
        table.add_column(column, justify="right" if number else "left")
    for line in lines:
        table.add_row(*line)
    Console(width=None if Console().is_terminal else 160).print(table)


@contextmanager
def _bars(runs: Path) -> Iterator[Report]:
    """A bar for all runs, and one for each that is at work."""
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    ended = threading.Event()
    with Bars(*columns, console=Console(stderr=True)) as bars:
        whole = bars.add_task("runs", total=None)

        def watch() -> None:
            shown: dict = {}
            while not ended.wait(LOOK_S):
                now = {each.stage: each for each in running(runs)}
                for stage in shown.keys() - now.keys():
                    bars.remove_task(shown.pop(stage))
                for stage, each in now.items():
                    if stage not in shown:
                        shown[stage] = bars.add_task(stage)
                    bars.update(shown[stage], completed=each.done, total=each.total)

        watcher = threading.Thread(target=watch, daemon=True)
        watcher.start()
        try:
            yield lambda progress: bars.update(whole, completed=progress.done, total=progress.total)
        finally:
            ended.set()
            watcher.join()
