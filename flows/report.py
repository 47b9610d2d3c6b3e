"""`presight report`: one HTML page of a city with its pictures, readable without a server."""

import html
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from flows.jobs import recipe_from
from flows.plan import city_frames
from presight_core.config import CitySettings, load_city_settings
from presight_core.drives import FrameTable
from presight_core.maps import prior_picture, tile_map
from presight_core.pictures import save_png
from presight_core.priors.reader import PriorReader
from presight_core.tiles import Tiling
from stages.tiling import sub_fields
from storage.workspace import Workspace

WIDEST_M = 400.0  # a street is still seen in a bird's-eye picture this wide
MARGIN_M = 30.0  # around the outermost camera
FIGURES = ("voxels", "bytes", "psnr_db", "steps", "rays_per_s", "seconds")
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1200px; margin: 2rem auto; padding: 0 1rem; color: #222; }
img { max-width: 100%; border: 1px solid #ccc; } table { border-collapse: collapse; }
td, th { padding: .25rem .8rem; border-bottom: 1px solid #ddd; text-align: right; }
td:first-child, th:first-child { text-align: left; } figcaption { color: #666; } figure { margin: 1.5rem 0; }
"""


def write_report(folder: Path, city: str, out: Path | None) -> Path:
    """The report's page, written with its pictures into `out`. Raises NotFoundError for a city without priors."""
    workspace = Workspace.open(folder).require()
    out = out or workspace.root / "reports" / city
    out.mkdir(parents=True, exist_ok=True)
    reader = PriorReader.open(workspace.store_location, city)
    settings = load_city_settings(workspace.city_file(city))
    frames = city_frames(workspace.drives(), tuple(workspace.catalog().drives(city)), settings)
    sections = [
        _facts(workspace, city, reader),
        _tiles(frames, settings, Tiling.from_json(reader.generation.tiling), out),
        _birds_eye(frames, reader, out),
        *(_rows(workspace, city, reader, tile_id, out) for tile_id in reader.tiles),
    ]
    page = out / "index.html"
    page.write_text(_page(city, sections), encoding="utf-8")
    return page


def _facts(workspace: Workspace, city: str, reader: PriorReader) -> str:
    drives = workspace.catalog().drives(city)
    rows: list[tuple[str, ...]] = [("tile", *FIGURES)]
    for tile_id in reader.tiles:
        metrics = reader.generation.tiles[tile_id].lineage.get("metrics", {})
        rows.append((tile_id, *(f"{metrics[name]:,.6g}" if name in metrics else "" for name in FIGURES)))
    drive_rows = [("drive", "captured", "frames"), *((d.name, d.captured, f"{d.frame_count:,}") for d in drives)]
    number, channels = reader.generation.number, reader.channel_count
    head = f"<p>Generation {number}, {channels} feature channels, feature space {reader.space_id}.</p>"
    return head + _table(rows) + _table(drive_rows)


def _tiles(frames: FrameTable, settings: CitySettings, tiling: Tiling, out: Path) -> str:
    members = tiling.rows_within(frames.positions, settings.tiling.overlap_m)
    boxes = [sub_fields(frames.positions[rows], settings.tiling) if len(rows) else () for rows in members]
    save_png(out / "tiles.png", tile_map(frames.positions, tiling, boxes))
    return _figure("tiles.png", "Camera positions, tiles and the sub-fields of each tile.")


def _birds_eye(frames: FrameTable, reader: PriorReader, out: Path) -> str:
    """The prior around the middle of the city, as wide as a picture can show."""
    low, high = frames.positions[:, :2].min(0) - MARGIN_M, frames.positions[:, :2].max(0) + MARGIN_M
    centre, half = (low + high) / 2, np.minimum((high - low) / 2, WIDEST_M / 2)
    world_from_view = np.eye(4)
    world_from_view[:2, 3] = centre
    x_m, y_m = (-float(half[0]), float(half[0])), (-float(half[1]), float(half[1]))
    window = reader.window(world_from_view, x_m, y_m, (-5.0, 10.0))
    save_png(out / "prior.png", prior_picture(window, x_m, y_m, reader.lattice.voxel_m))
    return _figure("prior.png", f"The prior from above, north up: {len(window):,} voxels in view.")


def _rows(workspace: Workspace, city: str, reader: PriorReader, tile_id: str, out: Path) -> str:
    """Held-out pictures of one tile, copied beside the page."""
    training = reader.generation.tiles[tile_id].recipe["inputs"]["training"]
    source = workspace.scratch(city, tile_id, recipe_from(training).digest) / "pictures" / "rows.png"
    if not source.exists():
        return f"<p>{tile_id}: its pictures were cleared from the caches.</p>"
    (out / f"{tile_id}.png").write_bytes(source.read_bytes())
    return _figure(f"{tile_id}.png", f"Tile {tile_id}: held-out frames, which the field never saw.")


def _figure(file: str, caption: str) -> str:
    text = html.escape(caption)
    return f'<figure><img src="{file}" alt="{text}"><figcaption>{text}</figcaption></figure>'


def _table(rows: Iterable[tuple[str, ...]]) -> str:
    head, *body = rows
    lines = ["<tr>" + "".join(f"<th>{html.escape(cell)}</th>" for cell in head) + "</tr>"]
    lines += ["<tr>" + "".join(f"<td>{html.escape(str(cell))}</td>" for cell in row) + "</tr>" for row in body]
    return "<table>" + "".join(lines) + "</table>"


def _page(city: str, sections: list[str]) -> str:
    title = html.escape(f"Priors of {city}")
    head = f'<meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>'
    return f'<!doctype html><html lang="en">{head}<h1>{title}</h1>{"".join(sections)}</html>\n'
