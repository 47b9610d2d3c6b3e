"""Stands for `python -m flows.worker`: the same words, with made-up voxels in place of the arithmetic.

What it does is told by files of the workspace: it trains until `hold` is gone, and writes a line into `work.log` for
all that it starts and ends.
"""

import json
import os
import sys
import threading
import time
import uuid
from pathlib import Path
from typing import Any

from flows.jobs import Job, recipe_from
from presight_core.priors.example import ExampleTile
from presight_core.progress import Progress
from storage.tile_groups import TileName
from tests.torture.toy_city import CHANNELS, ToyCity

STEPS = 1000


def work_of(city: ToyCity, what: str) -> list[dict[str, Any]]:
    """What workers began in a city, in order."""
    log = city.root / "work.log"
    lines = log.read_text().splitlines() if log.exists() else []
    return [entry for entry in map(json.loads, lines) if entry["what"] == what]


def train(job: Job, root: Path) -> dict[str, Any]:
    """Count steps while the workspace has a file `hold`; go on from where the last worker was."""
    checkpoint = job.scratch / "steps"
    step = int(checkpoint.read_text()) if checkpoint.exists() else 0
    _note(root, "train", job, step)
    while (root / "hold").exists():
        step = min(step + 1, STEPS - 1)
        checkpoint.parent.mkdir(parents=True, exist_ok=True)
        checkpoint.write_text(str(step))
        _send({"progress": vars(Progress("training", step, STEPS))})
        time.sleep(0.1)
    return {"folder": str(job.scratch), "metrics": {"psnr_db": 20.0}}


def extract(job: Job, root: Path) -> dict[str, Any]:
    """Write the made-up tile into the store."""
    _note(root, "extract", job, 0)
    tile = ExampleTile(side_blocks=2, channel_count=CHANNELS, drive_count=len(job.drive_ids), seed=job.tile)
    name = TileName(job.tile_id, f"{recipe_from(job.recipe).digest}-{uuid.uuid4().hex[:8]}")
    attributes = {"recipe": job.recipe, "space_id": job.space_id}
    store = job.opened_workspace.store()
    entry = store.write_tile(job.city, name, tile.batches(), sorted(job.drive_ids), attributes)
    return {"entry": entry.to_json(), "counts": {}, "seconds": 0.0}


def features(job: Job, root: Path) -> dict[str, Any]:
    """Nothing: nobody looks at the images."""
    _note(root, "features", job, 0)
    return {"images": 0, "rejects": []}


def _note(root: Path, what: str, job: Job, step: int) -> None:
    tile = job.tile_id if what != "features" else job.drive_ids[0]
    line = {"what": what, "tile": tile, "step": step, "process": os.getpid(), "parent": os.getppid()}
    with (root / "work.log").open("a") as log:
        log.write(json.dumps(line) + "\n")


def _send(message: dict[str, Any]) -> None:
    print(json.dumps(message), flush=True)


def _end_with_parent() -> None:
    sys.stdin.read()
    os._exit(137)


if __name__ == "__main__":
    job = Job.from_json(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    work = {"train": train, "extract": extract, "features": features}[sys.argv[1]]
    _send({"result": work(job, Path(job.workspace))})
