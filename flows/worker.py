"""The worker process: does one job and speaks JSON lines on its standard output.

`python -m flows.worker COMMAND`; the job is a line on its standard input, messages are {"progress": ...}, then
{"result": ...} or {"error": ...}. It ends when that input closes, so that no worker outlives a killed build.
"""

import json
import os
import shutil
import sys
import threading
import time
import traceback
import uuid
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.jobs import Job, recipe_from
from presight_core.drives import FrameTable
from presight_core.errors import PresightError
from presight_core.pixels import PixelSource
from presight_core.progress import Progress
from presight_core.recipes import WARM_START

REPORT_SECONDS = 0.5  # a person sees it move; the catalog is not flooded


def extract_features(job: Job) -> dict[str, Any]:
    """Label maps and features of one drive, into the cache."""
    from flows.plan import drive_frames
    from stages.features import FeatureExtractor, extract_drive

    workspace, settings = job.opened_workspace, job.opened_settings
    (drive_id,) = job.drive_ids
    drive = next(drive for drive in workspace.catalog().drives(job.city) if drive.drive_id == drive_id)
    frames = drive_frames(workspace.drives(), drive_id, settings)
    space, cache = workspace.artifacts().space(job.space_id), workspace.features()
    extractor = FeatureExtractor.load(settings.features, job.threads)
    figures: dict[str, float] = {}

    def note(progress: Progress) -> None:
        figures.update(progress.figures)
        say(progress)

    rows = cache.missing_rows(job.features_key, drive_id, len(frames))
    items = extract_drive(drive, frames, space, extractor, settings.features, rows, note)
    weights = space.channel_weights if settings.features.cache == "compact" else None
    rejects = cache.write(job.features_key, drive_id, frames, items, weights, figures)
    return {"images": len(frames), "rejects": [asdict(reject) for reject in rejects]}


def train(job: Job) -> dict[str, Any]:
    """A trained field in the tile's scratch folder, with its held-out metrics and pictures."""
    from presight_core.field.checkpoint import load_field
    from stages.evaluation import evaluate_tile
    from stages.training import train_tile

    record = job.scratch / "training.json"
    if record.exists():
        return json.loads(record.read_text())
    started = time.monotonic()
    training, source = _training(job)
    result = train_tile(training, source, job.scratch, say)
    field = load_field(result.folder, training.device)
    evaluation = evaluate_tile(training, field, source, job.scratch / "pictures", say)
    metrics = {**result.metrics, **evaluation.metrics, "seconds": _since(started)}
    trained = {"folder": str(result.folder), "metrics": metrics, "drive_psnr_db": evaluation.drive_psnr_db}
    return _record(record, trained)


def extract(job: Job) -> dict[str, Any]:
    """The tile's voxels, written to the store as one group that no generation shows yet."""
    from presight_core.field.checkpoint import load_field
    from presight_core.grid import Lattice
    from stages.extraction import TileExtraction, extract_tile
    from storage.tile_groups import TileName

    started = time.monotonic()
    trained = json.loads((job.scratch / "training.json").read_text())
    field = load_field(Path(trained["folder"]), job.device)
    training, source = _training(job)
    extraction = TileExtraction(
        job.tile, job.opened_tiling, Lattice(), training.frames, training.settings, training.feature_channels
    )
    voxels = extract_tile(extraction, field, source, job.scratch / "extraction", say)
    store = job.opened_workspace.store()
    # Unique, so that neither a retry nor a rebuilt catalog ever meets a name that is taken.
    name = TileName(job.tile_id, f"{recipe_from(job.recipe).digest}-{uuid.uuid4().hex[:8]}")
    attributes = {"recipe": job.recipe, "space_id": job.space_id}
    entry = store.write_tile(job.city, name, voxels.batches, voxels.drives, attributes)
    shutil.rmtree(job.scratch / "extraction")
    return {"entry": entry.to_json(), "counts": voxels.counts, "seconds": _since(started)}


def fit_space(job: Job) -> dict[str, Any]:
    """The feature space of the job's drives, frozen: of two fits at once, the first one counts."""
    from flows.plan import drive_frames, space_key
    from stages.features import FeatureExtractor
    from stages.space_fitting import SpaceImages, fit_space

    workspace, settings = job.opened_workspace, job.opened_settings
    wanted = set(job.drive_ids)
    drives = [drive for drive in workspace.catalog().drives(job.city) if drive.drive_id in wanted]
    index = workspace.drives()
    images = SpaceImages((drive, drive_frames(index, drive.drive_id, settings)) for drive in drives)
    space = fit_space(images, FeatureExtractor.load(settings.features, job.threads), settings.features, say)
    artifacts = workspace.artifacts()
    return {"space_id": artifacts.pin_space(space_key(settings), artifacts.save_space(space))}


def _training(job: Job) -> tuple[Any, PixelSource]:
    """The tile's training job and where its pixels come from."""
    from presight_core.field.files import read_sub_fields
    from stages.tiling import sub_fields
    from stages.training import TileTraining
    from storage.pixels import CachedPixels

    workspace, settings, frames = job.opened_workspace, job.opened_settings, job.frames()
    frames = frames.select(_readable(job, frames))
    roots = {drive.drive_id: drive.root for drive in workspace.catalog().drives(job.city)}
    cache = workspace.features()
    source = CachedPixels(frames, roots, cache, job.features_key, settings)
    channels = workspace.artifacts().space(job.space_id).channel_count
    start, steps = _start(job)
    fields = read_sub_fields(start.folder) if start else sub_fields(frames.positions, settings.tiling)
    settings = settings.model_copy(update={"training": settings.training.model_copy(update={"steps": steps})})
    return TileTraining(job.tile_id, frames, fields, settings, channels, job.threads, job.device, start), source


def _start(job: Job) -> tuple[Any, int]:
    """The field that the training goes on from, if any, and its steps."""
    from stages.warm_start import FieldStart

    begun = job.training_recipe["inputs"].get(WARM_START)
    if begun is None:
        return None, job.opened_settings.training.steps
    folder = job.opened_workspace.scratch(job.city, job.tile_id, begun["training"]) / "field"
    return FieldStart(folder, begun["training"], tuple(begun["drives"])), begun["steps"]


def _readable(job: Job, frames: FrameTable) -> NDArray[np.int64]:
    """Rows whose image the feature stage did not reject."""
    cache, key = job.opened_workspace.features(), job.features_key
    refused = set()
    for drive_id in job.drive_ids:
        paths = {row: path for path, row in cache.rows_of(key, drive_id).items()}
        refused |= {(drive_id, paths[row]) for row in cache.rejects(key, drive_id)}
    names = zip(frames.drive_id.tolist(), frames.path.tolist(), strict=True)
    return np.array([row for row, name in enumerate(names) if name not in refused], np.int64)


def _record(file: Path, value: dict[str, Any]) -> dict[str, Any]:
    """`value`, kept in `file`: all of it or nothing."""
    temporary = file.with_suffix(".part")
    temporary.write_text(json.dumps(value))
    temporary.replace(file)
    return value


def _since(started: float) -> float:
    return round(time.monotonic() - started, 2)


_last_report = [0.0, ""]


def say(progress: Progress) -> None:
    """Tell the parent where the stage is, a few times a second at most."""
    now = time.monotonic()
    is_news = progress.stage != _last_report[1] or progress.done >= progress.total
    if is_news or now - float(_last_report[0]) >= REPORT_SECONDS:
        _last_report[:] = [now, progress.stage]
        _send({"progress": asdict(progress)})


def _send(message: dict[str, Any]) -> None:
    print(json.dumps(message), flush=True)


def _end_with_parent() -> None:
    """Wait for standard input to close, which happens when the parent dies, then end at once."""
    sys.stdin.read()
    os._exit(137)


COMMANDS: dict[str, Callable[[Job], dict[str, Any]]] = {
    "fit-space": fit_space,
    "features": extract_features,
    "train": train,
    "extract": extract,
}


def main(command: str) -> int:
    """Do one job; 0 if it gave a result."""
    job = Job.from_json(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        _send({"result": COMMANDS[command](job)})
    except PresightError as error:
        _send({"error": {"name": type(error).__name__, "message": str(error)}})
        return error.exit_code
    except Exception as error:
        traceback.print_exc()
        _send({"error": {"name": type(error).__name__, "message": str(error)}})
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
