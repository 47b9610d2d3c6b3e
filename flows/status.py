"""`presight status`: the state of every tile, from the catalog alone."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from flows.console import print_json, print_table
from presight_core.errors import NotFoundError
from storage.catalog import Build
from storage.workspace import Workspace

COLUMNS = ("city", "tile", "state", "stage", "done", "voxels", "PSNR dB", "generation", "updated (UTC)", "error")


def show_status(folder: Path, city: str | None, as_json: bool) -> None:
    """Print the latest build of every tile of a city, or of all cities."""
    catalog = Workspace.open(folder).require().catalog()
    cities = catalog.cities()
    if city is not None and city not in cities:
        raise NotFoundError(f"{city}: no such city here; known: {', '.join(cities) or 'none'}")
    chosen = [city] if city else cities
    builds = {name: catalog.builds(name) for name in chosen}
    if as_json:
        print_json({name: [_values(build) for build in builds[name]] for name in chosen})
        return
    rows = [_row(name, build) for name in chosen for build in builds[name]]
    if rows:
        print_table(str(folder), COLUMNS, rows)
    for name in chosen:
        if not builds[name]:
            print(f"{name}: ingested, nothing built yet; next: presight plan {name}")


def _values(build: Build) -> dict[str, Any]:
    """A build as JSON values; its recipe, which is long, by digest only."""
    return {name: value for name, value in asdict(build).items() if name != "recipe"}


def _row(city: str, build: Build) -> tuple[object, ...]:
    percent = f"{100 * build.done / build.total:.0f} %" if build.total else ""
    first_line = build.error.splitlines()[0] if build.error else ""
    psnr = build.metrics.get("psnr_db")
    return (
        city,
        build.tile_id,
        build.state,
        build.stage,
        percent,
        f"{build.metrics['voxels']:,}" if "voxels" in build.metrics else "",
        f"{psnr:.1f}" if psnr is not None else "",
        build.metrics.get("generation", ""),
        build.updated_at[:19].replace("T", " "),
        first_line,
    )
