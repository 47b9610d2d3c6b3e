"""`presight diff`: which voxels two generations of a city do not share, as figures and from above."""

from pathlib import Path

import numpy as np

from flows.console import print_json, print_table
from presight_core.grid import Lattice
from presight_core.maps import FOOTPRINT, MapView, birds_eye
from presight_core.pictures import Rgb, save_png, stack_rows
from presight_core.priors.difference import TileDifference, tile_difference
from presight_core.priors.reader import PriorReader
from storage.workspace import Workspace

# Colours that people with any colour vision tell apart; later ones are drawn over earlier ones.
COLOURS = {"same": (190, 190, 190), "changed": (230, 159, 0), "removed": (213, 60, 0), "added": (0, 114, 178)}
WIDEST_PX = 1600  # longer side of the picture
MARGIN_M = 5.0  # around the outermost voxel


def show_difference(folder: Path, city: str, pair: tuple[str, str], png: Path | None, as_json: bool) -> None:
    """Print the counts of every tile that differs, and draw the voxels if a file is given."""
    location = Workspace.open(folder).store_location
    old, new = (PriorReader.open(location, city, int(name) if name.isdigit() else name) for name in pair)
    differences = differing_tiles(old, new, unchanged=png is not None)
    counts = {tile_id: {kind: len(getattr(tile, kind)) for kind in COLOURS} for tile_id, tile in differences.items()}
    changed = {tile_id: row for tile_id, row in counts.items() if any(row[kind] for kind in list(COLOURS)[1:])}
    if png is not None:
        save_png(png, difference_picture(list(differences.values()), new.lattice))
    if as_json:
        numbers = {"city": city, "old": old.generation.number, "new": new.generation.number}
        print_json({**numbers, "tiles": changed, "png": str(png) if png else None})
        return
    title = f"{city}: generation {old.generation.number} to {new.generation.number}"
    print_table(title, ["tile", *COLOURS], [[tile_id, *row.values()] for tile_id, row in changed.items()])


def differing_tiles(old: PriorReader, new: PriorReader, unchanged: bool) -> dict[str, TileDifference]:
    """Differences by tile; tiles whose content is equal only if asked for."""
    tiles = {}
    for tile_id in sorted({*old.tiles, *new.tiles}):
        before, after = old.generation.tiles.get(tile_id), new.generation.tiles.get(tile_id)
        if not unchanged and before and after and before.entry.digest == after.entry.digest:
            continue
        tiles[tile_id] = tile_difference(
            old.tile(tile_id) if before else None,
            new.tile(tile_id) if after else None,
        )
    return tiles


def difference_picture(tiles: list[TileDifference], lattice: Lattice) -> Rgb:
    """All voxels from above, coloured by what became of them: in each column, the most telling one is seen."""
    parts, colours = [], []
    for height, (kind, colour) in enumerate(COLOURS.items()):
        voxels = np.concatenate([np.zeros((0, 3), np.int64), *(getattr(tile, kind) for tile in tiles)])
        columns = np.unique(voxels[:, :2], axis=0)
        centres = (columns + 0.5) * lattice.voxel_m + lattice.origin_m[:2]
        parts.append(np.column_stack([centres, np.full(len(centres), float(height))]))
        colours.append(np.tile(np.array(colour, np.uint8), (len(centres), 1)))
    points = np.concatenate(parts)
    (left, bottom), (right, top) = (points[:, :2].min(0) - MARGIN_M, points[:, :2].max(0) + MARGIN_M)
    pixel_m = max(lattice.voxel_m / 2, (right - left) / WIDEST_PX, (top - bottom) / WIDEST_PX)
    view = MapView((left, right), (bottom, top), pixel_m)
    title = "grey: the same, orange: changed, red: removed, blue: added"
    return stack_rows([[birds_eye(points, np.concatenate(colours), view, FOOTPRINT * lattice.voxel_m)]], [title])
