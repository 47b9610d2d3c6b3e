"""What a build of a city would do: its tiles, which are stale and why, and what that costs.

Planning reads and never writes; it imports neither torch nor Prefect.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flows.console import print_json, print_table
from presight_core import masking
from presight_core.config import CitySettings, load_city_settings
from presight_core.drives import Drive, FrameTable
from presight_core.errors import NotFoundError
from presight_core.grid import Lattice
from presight_core.model_card import ModelCard
from presight_core.priors.documents import Generation
from presight_core.recipes import Recipe, differences
from presight_core.tiles import Tiling
from stages import tiling, versions
from storage.catalog import Build
from storage.drives import DriveIndex
from storage.workspace import Workspace

MIN_FRAMES = 8  # fewer images than this cannot constrain a field; the tile is left out and said so
PLAN_COLUMNS = ("tile", "drives", "frames", "state", "why", "last build")
BYTES_PER_VOXEL = 80  # the format's upper bound at 64 channels, for the disk estimate


@dataclass(frozen=True)
class TilePlan:
    """One tile: what it would be built from, and why it is stale (no reasons: it is current)."""

    tile: int  # index in the tiling
    tile_id: str
    drive_ids: tuple[str, ...]  # drives with frames that train the tile
    frame_count: int
    training: Recipe | None  # None until the feature space exists
    recipe: Recipe | None  # the whole tile: training, then extraction
    reasons: tuple[str, ...]
    seconds: float | None  # what its last build took, if there was one
    voxel_count: int  # of the published build, 0 if none

    @property
    def is_stale(self) -> bool:
        """Whether a build would rebuild the tile."""
        return bool(self.reasons)


@dataclass(frozen=True)
class CityPlan:
    """A city's tiles against its published generation."""

    city: str
    settings: CitySettings
    drives: tuple[Drive, ...]
    tiling: Tiling
    lattice: Lattice
    space_id: str | None  # None: no feature space fitted yet
    features: Recipe | None
    tiles: tuple[TilePlan, ...]
    skipped: tuple[str, ...]  # tiles with too few frames
    generation: int | None

    @property
    def stale(self) -> tuple[TilePlan, ...]:
        """The tiles that a build would rebuild."""
        return tuple(tile for tile in self.tiles if tile.is_stale)


def plan_city(workspace: Workspace, city: str, settings: CitySettings) -> CityPlan:
    """The plan of a city under the given settings. Raises NotFoundError for a city without drives."""
    catalog = workspace.catalog()
    drives = tuple(catalog.drives(city))
    if not drives:
        known = ", ".join(catalog.cities()) or "none yet"
        raise NotFoundError(
            f"{city}: no drives in {workspace.root}; cities known here: {known}; ingest its drives first"
        )
    frames = city_frames(workspace.drives(), drives, settings)
    city_tiling = _tiling(catalog.tiling(city), city, frames, settings)
    space_id = settings.features.space or workspace.artifacts().pinned_space(space_key(settings))
    features = features_recipe(settings, space_id) if space_id else None
    generation = workspace.store().generation(city)
    past = {build.tile_id: build for build in catalog.builds(city)}
    lattice = Lattice()
    tiles, skipped = [], []
    for index, tile in enumerate(city_tiling.tiles):
        members = tile_frames(frames, city_tiling, index, settings)
        if len(members) < MIN_FRAMES:
            skipped.append(f"{tile.tile_id}: {len(members)} frames, at least {MIN_FRAMES} are needed")
            continue
        training, recipe = (
            (None, None) if features is None else _recipes(city_tiling, index, members, settings, features)
        )
        tiles.append(_tile_plan(index, tile.tile_id, members, (training, recipe), generation, past.get(tile.tile_id)))
    number = generation.number if generation else None
    return CityPlan(
        city, settings, drives, city_tiling, lattice, space_id, features, tuple(tiles), tuple(skipped), number
    )


def city_frames(index: DriveIndex, drives: tuple[Drive, ...], settings: CitySettings) -> FrameTable:
    """All frames of the drives that the settings let take part."""
    return FrameTable.concatenate([drive_frames(index, drive.drive_id, settings) for drive in drives])


def drive_frames(index: DriveIndex, drive_id: str, settings: CitySettings) -> FrameTable:
    """The frames of one drive that the settings let take part."""
    frames = index.frames(drive_id)
    return frames.select(frames.is_keyframe) if settings.training.keyframes_only else frames


def tile_frames(frames: FrameTable, city_tiling: Tiling, tile: int, settings: CitySettings) -> FrameTable:
    """The frames that train a tile: those in its cell, and around it as far as the overlap."""
    return frames.select(city_tiling.within(frames.positions, tile, settings.tiling.overlap_m))


def space_key(settings: CitySettings) -> dict[str, Any]:
    """What decides which feature space is used: the feature model and the number of channels."""
    card = ModelCard.load(settings.features.feature_model, "features")
    return {"feature_model": card.identity, "channels": settings.features.channels}


def features_recipe(settings: CitySettings, space_id: str) -> Recipe:
    """The recipe of every drive's label maps and features."""
    models = {
        "segmentation_model": ModelCard.load(settings.features.segmentation_model, "segmentation").identity,
        "feature_model": ModelCard.load(settings.features.feature_model, "features").identity,
        "space": space_id,
    }
    features = settings.features
    chosen = {"masks": features.masks, "cache": features.cache, "parked_cars": features.parked_cars}
    chosen |= {"keyframes_only": settings.training.keyframes_only}
    return Recipe("features", versions.FEATURES, chosen, models)


def _tiling(frozen: Tiling | None, city: str, frames: FrameTable, settings: CitySettings) -> Tiling:
    """The city's frozen tiling, with new tiles founded on new ground; the first one if there is none."""
    if frozen is None:
        return tiling.cut_city(city, frames.positions, settings.tiling)
    return tiling.extend_tiling(frozen, frames.positions, settings.tiling)


def _recipes(
    city_tiling: Tiling, tile: int, members: FrameTable, settings: CitySettings, features: Recipe
) -> tuple[Recipe, Recipe]:
    """The recipes of a tile's training and of the whole tile."""
    values = settings.model_dump(mode="json")
    chosen = {name: values[name] for name in ("field", "sampling", "training", "tiling")}
    chosen["training"] = {name: value for name, value in chosen["training"].items() if name != "checkpoint_every"}
    chosen["tiling"] = {name: value for name, value in chosen["tiling"].items() if name not in ("tile_count", "seed")}
    inputs = {
        "drives": np.unique(members.drive_id).tolist(),
        "features": features.to_json(),
        "dynamic_classes": list(settings.features.dynamic_classes),
        "moving": masking.recipe(settings.features),
        "tile": city_tiling.tiles[tile].tile_id,
        "centroid_m": list(city_tiling.tiles[tile].centroid_m),
    }
    training = Recipe("training", versions.TRAINING, chosen, inputs)
    whole = Recipe("tile", versions.EXTRACTION, {"extraction": values["extraction"]}, {"training": training.to_json()})
    return training, whole


def _tile_plan(
    index: int,
    tile_id: str,
    members: FrameTable,
    recipes: tuple[Recipe | None, Recipe | None],
    generation: Generation | None,
    past: Build | None,
) -> TilePlan:
    published = generation.tiles.get(tile_id) if generation else None
    if published is None:
        reasons = ["never built"]
    elif recipes[1] is None:
        reasons = ["the feature space is not fitted"]
    else:
        reasons = [_readable(line) for line in differences(published.recipe, recipes[1].to_json())]
    return TilePlan(
        tile=index,
        tile_id=tile_id,
        drive_ids=tuple(np.unique(members.drive_id).tolist()),
        frame_count=len(members),
        training=recipes[0],
        recipe=recipes[1],
        reasons=tuple(reasons),
        seconds=past.metrics.get("seconds") if past else None,
        voxel_count=published.entry.voxel_count if published else 0,
    )


def _readable(difference: str) -> str:
    """A recipe's difference without the nesting that the recipe needs."""
    return difference.replace("inputs.training.", "").replace("inputs.", "").replace("settings.", "")


def show_plan(folder: Path, city: str, overrides: list[str], as_json: bool) -> None:
    """Print the plan of a city."""
    workspace = Workspace.open(folder).require()
    plan = plan_city(workspace, city, load_city_settings(workspace.city_file(city), overrides))
    if as_json:
        print_json(plan_json(plan))
        return
    rows = [
        (
            tile.tile_id,
            len(tile.drive_ids),
            tile.frame_count,
            "stale" if tile.is_stale else "current",
            "; ".join(tile.reasons),
            f"{tile.seconds:.0f} s" if tile.seconds else "unknown",
        )
        for tile in plan.tiles
    ]
    print_table(f"{city}: {len(plan.stale)} of {len(plan.tiles)} tiles to build", PLAN_COLUMNS, rows)
    for line in plan.skipped:
        print(f"left out: {line}")
    print(cost_line(plan))


def plan_json(plan: CityPlan) -> dict[str, Any]:
    """The plan as JSON values."""
    return {
        "city": plan.city,
        "generation": plan.generation,
        "drives": [drive.name for drive in plan.drives],
        "tiling": plan.tiling.to_json(),
        "space_id": plan.space_id,
        "left_out": list(plan.skipped),
        "tiles": [
            {
                "tile_id": tile.tile_id,
                "drives": list(tile.drive_ids),
                "frames": tile.frame_count,
                "stale": tile.is_stale,
                "reasons": list(tile.reasons),
                "seconds_last_time": tile.seconds,
                "voxels": tile.voxel_count,
            }
            for tile in plan.tiles
        ],
    }


def cost_line(plan: CityPlan) -> str:
    """What building the stale tiles takes, as far as past builds tell."""
    if not plan.stale:
        return f"nothing stale; generation {plan.generation} is current"
    training = plan.settings.training
    rays = training.steps * training.batch_rays * len(plan.stale)
    known = [tile.seconds for tile in plan.stale if tile.seconds]
    time = (
        f"about {sum(known) / len(known) * len(plan.stale):.0f} s of tile time"
        if known
        else "time unknown (no past build)"
    )
    voxels = sum(tile.voxel_count for tile in plan.stale)
    disk = f", about {voxels * BYTES_PER_VOXEL / 1e6:.0f} MB in the store" if voxels else ""
    return f"cost: {rays / 1e6:,.1f} M rays, {time}{disk}; next: presight build {plan.city}"
