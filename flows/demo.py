"""`presight synth` and `presight demo`: the embedded city, and its priors from nothing."""

import time
from pathlib import Path

from flows.console import progress_bars
from storage.workspace import Workspace

CITY = "singapore-onenorth"  # official map names only, so that the official devkit can load the data set
VERSION = "v1.0-mini"
SETTINGS = """# Settings of the embedded city; see README, Settings.
preset = "demo"

[tiling]
tile_count = 2 # one for each core; by its area alone the city would be one tile
overlap_m = 15.0
"""


def generate_city(out: Path, name: str, seed: int, overrides: list[str]) -> None:
    """Write the embedded city to `out`, going on where an earlier call was interrupted."""
    from presight_core.synthetic import load_preset, write_dataset

    preset = load_preset(name, overrides)
    with progress_bars() as report:
        write_dataset(out, preset, seed, report)
    print(f"{out}: {', '.join(preset.towns)} in nuScenes format, all at a glance in {out / 'contact_sheet.png'}")
    print(f"next: presight ingest {out} --version {preset.version}")


def run_demo(folder: Path, overrides: list[str]) -> None:
    """Generate the small city, build its priors through the flow, draw them, and say where to look."""
    from flows.build import Request as BuildRequest
    from flows.build import build_city
    from flows.ingest import ingest_root
    from flows.report import write_report
    from flows.status import Request, show_status

    started = time.monotonic()
    _write_settings(Workspace.open(folder))
    data = folder / "embedded-city"
    generate_city(data, "demo", seed=0, overrides=[])
    ingest_root(folder, data, VERSION, keep_going=False, as_json=False)
    build_city(folder, BuildRequest(CITY, overrides))
    show_status(folder, Request(CITY))
    page = write_report(folder, CITY, None)
    print(f"done in {time.monotonic() - started:.0f} s; look at {page}")
    print(f"ask it:  presight --workspace {folder} query {CITY} --at X,Y,YAW --png prior.png")


def _write_settings(workspace: Workspace) -> None:
    """Leave the demo's settings where every later command finds them; settings that are there stay."""
    file = workspace.city_file(CITY)
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(SETTINGS, encoding="utf-8")
