"""Time a build that nothing disturbs, and the same build killed (kill -9) half-way through its training and run again.

python -m bench.resume WORKSPACE CITY [SHARE]

WORKSPACE has its drives and settings, and nothing of the city is built; it is copied, and stays as it is. Both run side
by side, so that they meet the same load of the machine, and what they publish must be equal.
"""

import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from presight_core.field.checkpoint import load_tensors
from storage.catalog import Build
from storage.workspace import Workspace

POLL_S = 0.1


def start(workspace: Path, city: str) -> subprocess.Popen[bytes]:
    """A build, as a user starts it."""
    command = [sys.executable, "-m", "flows.cli", "--workspace", str(workspace), "build", city]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def build(workspace: Path, city: str) -> float:
    """Build to the end; seconds."""
    started = time.monotonic()
    assert start(workspace, city).wait() == 0, "the build failed; run it by hand to see why"
    return time.monotonic() - started


def build_and_kill(workspace: Path, city: str, share: float) -> tuple[float, dict[str, int]]:
    """Build until some training is so far, and kill; seconds, and how far each training was."""
    started, process = time.monotonic(), start(workspace, city)
    catalog = Workspace.open(workspace).catalog()
    while not any(_is_so_far(each, share) for each in catalog.running(city)):
        assert process.poll() is None, "the build ended before it could be killed"
        time.sleep(POLL_S)
    process.kill()
    process.wait()
    seconds = time.monotonic() - started
    return seconds, {each.tile_id: each.done for each in catalog.running(city) if each.stage == "training"}


def _is_so_far(each: Build, share: float) -> bool:
    return each.stage == "training" and each.done >= share * each.total > 0


def saved_steps(workspace: Path, city: str) -> dict[str, int]:
    """The step of each tile's checkpoint."""
    scratch = Workspace.open(workspace).caches / "scratch" / city
    files = scratch.glob("*/*/training.safetensors")
    return {file.parent.parent.name: load_tensors(file)[1]["step"] for file in files}


def digests(workspace: Path, city: str) -> dict[str, str]:
    """What the city's prior shows."""
    generation = Workspace.open(workspace).store().generation(city)
    assert generation is not None
    return {tile_id: tile.entry.digest for tile_id, tile in generation.tiles.items()}


def build_in_parts(workspace: Path, city: str, share: float) -> str:
    """Build, kill, and build again; what came of it, in words."""
    first_s, done = build_and_kill(workspace, city, share)
    saved = saved_steps(workspace, city)
    second_s = build(workspace, city)
    lost = {tile_id: step - saved.get(tile_id, 0) for tile_id, step in done.items()}
    return (
        f"killed after {first_s:.0f} s with training at step {done}, checkpoints of step {saved}; run again: "
        f"{second_s:.0f} s; both {first_s + second_s:.0f} s; steps lost {lost}"
    )


def main(source: Path, city: str, share: float = 0.5) -> None:
    """Print both times, and what was lost."""
    with tempfile.TemporaryDirectory(dir=source.parent) as folder, ThreadPoolExecutor() as pool:
        whole, parts = (Path(shutil.copytree(source, Path(folder) / name)) for name in ("whole", "parts"))
        unbroken, broken = pool.submit(build, whole, city), pool.submit(build_in_parts, parts, city, share)
        print(f"unbroken: {unbroken.result():.0f} s", flush=True)
        print(broken.result())
        print(f"equal content: {digests(whole, city) == digests(parts, city)}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], *(float(share) for share in sys.argv[3:]))
