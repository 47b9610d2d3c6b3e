"""One tile of a workspace, opened for training in this process, so that benches can look at the field on its way."""

import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from flows.plan import CityPlan, city_frames, plan_city, tile_frames
from presight_core.config import load_city_settings
from presight_core.field.tile_field import TileField
from presight_core.grid import Lattice
from presight_core.pixels import PixelSource
from stages.extraction import TileExtraction
from stages.feeding import Feed
from stages.tiling import sub_fields
from stages.training import Run, TileTraining, known_depths, training_rows
from storage.pixels import CachedPixels
from storage.workspace import Workspace


@dataclass(frozen=True)
class BenchTile:
    """A tile whose drives are ingested and have features."""

    plan: CityPlan
    job: TileTraining
    extraction: TileExtraction
    source: PixelSource


def open_tile(folder: Path, city: str, index: int, overrides: list[str], thread_count: int = 1) -> BenchTile:
    """A tile of a city of the workspace in `folder`, under its settings and `key=value` overrides.

    Raises NotFoundError for a city without drives, and where the city was never built: its features are needed.
    """
    workspace = Workspace.open(folder)
    settings = load_city_settings(workspace.city_file(city), overrides)
    plan = plan_city(workspace, city, settings)
    assert plan.features is not None and plan.space_id is not None, f"{city}: build it first, for its features"
    frames = tile_frames(city_frames(workspace.drives(), plan.drives, settings), plan.tiling, index, settings)
    roots = {drive.drive_id: drive.root for drive in plan.drives}
    source = CachedPixels(frames, roots, workspace.features(), plan.features.digest, settings)
    channels = workspace.artifacts().space(plan.space_id).channel_count
    parts = sub_fields(frames.positions, settings.tiling)
    job = TileTraining(plan.tiling.tiles[index].tile_id, frames, parts, settings, channels, thread_count)
    return BenchTile(plan, job, TileExtraction(index, plan.tiling, Lattice(), frames, settings, channels), source)


def train(tile: BenchTile, marks: list[int]) -> Iterator[tuple[int, float, TileField]]:
    """The field after the steps of `marks` and at the end, with the processor minutes that training took so far."""
    settings = tile.job.settings.training
    with tempfile.TemporaryDirectory() as scratch:
        rows = training_rows(tile.job.frames, settings)
        spent, started = 0.0, time.process_time()
        run = Run(tile.job, Path(scratch), known_depths(tile.job, tile.source, rows, Path(scratch)))
        with Feed(tile.job, tile.source, rows) as feed:
            for step in range(settings.steps):
                run.train(step, feed.batch(step))
                if step + 1 in marks or step + 1 == settings.steps:
                    spent += time.process_time() - started
                    yield step + 1, spent / 60, run.field
                    started = time.process_time()


def marks_of(text: str) -> list[int]:
    """Steps of a list such as `500,1000`."""
    return [int(step) for step in text.split(",") if step]
