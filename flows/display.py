"""Progress bars of a running build, drawn from the catalog: what it says is what `presight status` says."""

import threading
from contextlib import AbstractContextManager

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TaskProgressColumn, TextColumn, TimeElapsedColumn

from flows.background import beside
from storage.catalog import Build, Catalog

POLL_SECONDS = 0.5


def watch_builds(catalog: Catalog, city: str) -> AbstractContextManager[None]:
    """Show the city's builds that start before the block ends."""
    known = {build.build_id for build in catalog.builds(city)}
    return beside(lambda stop: _draw(catalog, city, known, stop), f"progress of {city}")


def _draw(catalog: Catalog, city: str, known: set[int], stop: threading.Event) -> None:
    columns = (
        TextColumn("{task.description:<22}"),
        BarColumn(24),
        TaskProgressColumn(),
        TextColumn("{task.fields[figures]}"),
    )
    console = Console(stderr=True)
    bars: dict[tuple[str, str], TaskID] = {}
    with Progress(*columns, TimeElapsedColumn(), console=console) as progress:
        while not stop.wait(POLL_SECONDS):
            for build in catalog.builds(city):
                if build.build_id not in known:
                    _update(progress, bars, build, console)


def _update(progress: Progress, bars: dict[tuple[str, str], TaskID], build: Build, console: Console) -> None:
    """Move the bar of the build's stage; a stage that ended keeps its full bar."""
    stage = build.stage or "waiting"
    if (build.tile_id, stage) not in bars:
        for (tile_id, _), bar in bars.items():
            if tile_id == build.tile_id:
                progress.update(bar, completed=progress.tasks[bar].total)
                progress.stop_task(bar)
        name = f"{build.tile_id} {stage}"
        bars[build.tile_id, stage] = progress.add_task(name, total=max(build.total, 1), figures="")
        if not console.is_terminal:
            console.print(name)
    bar = bars[build.tile_id, stage]
    progress.update(bar, total=max(build.total, 1), completed=build.done, figures=figures_text(build.figures))
    if build.state in ("published", "built", "failed"):
        progress.stop_task(bar)


def figures_text(figures: dict[str, float]) -> str:
    """Figures as short text: `loss 0.0123  psnr 24.1`."""
    return "  ".join(f"{name} {value:.4g}" for name, value in figures.items())
