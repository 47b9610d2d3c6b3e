"""What a build of a city would do: its tiles, which are stale and why.

Planning reads and never writes, but for `record_plan`; it imports neither torch nor Prefect.
"""

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.drives import CityDrives, choose_drives, require_split_apart
from flows.staleness import Reason, stale_reasons
from flows.warm_start import StaleTile, Start, find_start
from presight_core import masking
from presight_core.config import CitySettings
from presight_core.drives import Drive, FrameTable
from presight_core.errors import InputError, NotFoundError
from presight_core.grid import Lattice
from presight_core.model_card import ModelCard
from presight_core.priors.documents import Generation
from presight_core.recipes import Recipe
from presight_core.tiles import Tiling
from stages import tiling, versions
from storage.catalog import Build
from storage.drive_positions import DrivePositions, read_positions
from storage.drives import DriveIndex
from storage.tile_states import PlannedTile
from storage.workspace import Workspace

MIN_FRAMES = 8  # fewer images than this cannot constrain a field; the tile is left out and said so


@dataclass(frozen=True)
class Members:
    """The frames that train one tile, by what a plan must know of them."""

    drive_ids: tuple[str, ...]  # sorted
    positions: NDArray[np.float64]  # (M, 3) camera centres, world metres

    @staticmethod
    def of(frames: DrivePositions, rows: NDArray[np.int64]) -> "Members":
        """The given rows of a city's frames."""
        drives = np.unique(frames.drive[rows]).tolist()
        return Members(tuple(sorted(frames.drive_ids[drive] for drive in drives)), frames.positions[rows])

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True)
class TilePlan:
    """One tile: what it would be built from, and why it is stale (no reasons: it is current)."""

    tile: int  # index in the tiling
    tile_id: str
    drive_ids: tuple[str, ...]  # drives with frames that train the tile
    frame_count: int
    training: Recipe | None  # None until the feature space exists
    recipe: Recipe | None  # the whole tile: training, then extraction
    causes: tuple[Reason, ...]
    past: Build | None  # its last build that was published
    voxel_count: int  # of the published build, 0 if none
    bytes: int  # likewise
    start: Start | None = None  # of an update; None if it is current, or its recipe is not known

    def recipes(self, warm: bool) -> tuple[Recipe, Recipe]:
        """The recipes of the training and of the whole tile: as an update follows them, or from nothing."""
        assert self.training is not None
        assert self.recipe is not None
        if not (warm and self.start):
            return self.training, self.recipe
        return self.start.training, replace(self.recipe, inputs={"training": self.start.training.to_json()})

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why it is stale, in words."""
        return tuple(cause.text for cause in self.causes)

    @property
    def is_stale(self) -> bool:
        """Whether a build would rebuild the tile."""
        return bool(self.causes)


@dataclass(frozen=True)
class CityPlan:
    """A city's tiles against its published generation."""

    city: str
    settings: CitySettings
    known: CityDrives
    tiling: Tiling
    lattice: Lattice
    space_id: str | None  # None: no feature space fitted yet
    features: Recipe | None
    tiles: tuple[TilePlan, ...]
    skipped: tuple[str, ...]  # tiles with too few frames
    withdrawn: dict[str, str]  # published tiles that contain a barred drive and cannot be built without it, and why
    generation: int | None

    @property
    def drives(self) -> tuple[Drive, ...]:
        """The drives that make the prior, by capture time."""
        return self.known.builders

    @property
    def is_current(self) -> bool:
        """Whether there is nothing to build and nothing to withdraw."""
        return not self.stale and not self.withdrawn

    @property
    def stale(self) -> tuple[TilePlan, ...]:
        """The tiles that a build would rebuild."""
        return tuple(tile for tile in self.tiles if tile.is_stale)


def plan_city(workspace: Workspace, city: str, settings: CitySettings) -> CityPlan:
    """The plan of a city under the given settings.

    Raises NotFoundError for a city without drives, InputError where none may make a prior or the split overlaps.
    """
    catalog = workspace.catalog()
    known = choose_drives(catalog.drive_records(city), settings.split)
    generation = workspace.store().generation(city)
    if not known.builders and generation is None:
        raise _no_drives(workspace, city, known)
    require_split_apart(city, workspace.drives(), known, settings.split)
    frames = _positions(workspace, city, known.builders, settings) if known.builders else None
    city_tiling = _tiling(workspace, city, frames, generation, settings)
    members_of = _members(frames, city_tiling, settings) if frames else []
    space_id = settings.features.space or workspace.artifacts().pinned_space(space_key(settings))
    features = features_recipe(settings, space_id) if space_id else None
    planner = _TilePlanner(workspace, settings, known, city_tiling, features, generation)
    past = {build.tile_id: build for build in catalog.builds(city, "published")}
    tiles, skipped = [], []
    for index, (tile, members) in enumerate(zip(city_tiling.tiles, members_of, strict=False)):
        if len(members) < MIN_FRAMES:
            skipped.append(f"{tile.tile_id}: {len(members)} frames, at least {MIN_FRAMES} are needed")
        else:
            tiles.append(planner.plan(index, members, past.get(tile.tile_id)))
    return CityPlan(
        city=city,
        settings=settings,
        known=known,
        tiling=city_tiling,
        lattice=Lattice(),
        space_id=space_id,
        features=features,
        tiles=tuple(tiles),
        skipped=tuple(skipped),
        withdrawn=_withdrawn(generation, known, {tile.tile_id for tile in tiles}),
        generation=generation.number if generation else None,
    )


@dataclass(frozen=True)
class _TilePlanner:
    """Plans one tile after the other, against the generation that is shown."""

    workspace: Workspace
    settings: CitySettings
    known: CityDrives
    tiling: Tiling
    features: Recipe | None
    generation: Generation | None

    @cached_property
    def index(self) -> DriveIndex:
        """One for all tiles: it keeps what it has read."""
        return self.workspace.drives()

    def plan(self, index: int, members: Members, past: Build | None) -> TilePlan:
        """The plan of one tile, by its index in the tiling."""
        tile_id = self.tiling.tiles[index].tile_id
        training, recipe = self._recipes(index, members)
        shown = self.generation.tiles.get(tile_id) if self.generation else None
        published = shown.recipe if shown else None
        causes = stale_reasons(published, recipe.to_json() if recipe else None, known=self.known, index=self.index)
        start = None
        if causes and training:
            stale = StaleTile(self.tiling.city, tile_id, training, causes, members.positions)
            start = find_start(self.workspace, stale, published, self.settings)
        return TilePlan(
            tile=index,
            tile_id=tile_id,
            drive_ids=members.drive_ids,
            frame_count=len(members),
            training=training,
            recipe=recipe,
            causes=causes,
            past=past,
            voxel_count=shown.entry.voxel_count if shown else 0,
            bytes=shown.entry.bytes if shown else 0,
            start=start,
        )

    def _recipes(self, index: int, members: Members) -> tuple[Recipe | None, Recipe | None]:
        """The recipes of a tile's training and of the whole tile; None until the feature space exists."""
        if self.features is None:
            return None, None
        settings, tile = self.settings, self.tiling.tiles[index]
        values = settings.model_dump(mode="json")
        chosen = {name: values[name] for name in ("field", "sampling", "training", "tiling")}
        chosen["training"] = {name: value for name, value in chosen["training"].items() if name != "checkpoint_every"}
        of_city = ("tile_count", "seed")
        chosen["tiling"] = {name: value for name, value in chosen["tiling"].items() if name not in of_city}
        inputs = {
            "drives": list(members.drive_ids),
            "features": self.features.to_json(),
            "dynamic_classes": list(settings.features.dynamic_classes),
            "moving": masking.recipe(settings.features),
            "tile": tile.tile_id,
            "centroid_m": list(tile.centroid_m),
        }
        training = Recipe("training", versions.TRAINING, chosen, inputs)
        extraction = {"extraction": values["extraction"]}
        return training, Recipe("tile", versions.EXTRACTION, extraction, {"training": training.to_json()})


def _no_drives(workspace: Workspace, city: str, known: CityDrives) -> InputError | NotFoundError:
    if known.parts:
        return InputError(
            f"{city}: none of its {len(known.parts)} drives makes a prior; see `presight drives list {city}` and the "
            f"split in {workspace.city_file(city)}"
        )
    cities = ", ".join(workspace.catalog().cities()) or "none yet"
    return NotFoundError(f"{city}: no drives in {workspace.root}; cities known here: {cities}; ingest its drives first")


def _withdrawn(generation: Generation | None, known: CityDrives, planned: set[str]) -> dict[str, str]:
    """Tiles that may not be shown any longer and have too few frames of other drives to be built without them."""
    shown = generation.tiles if generation else {}
    tainted = {tile_id: known.why_barred(tile.entry.drives) for tile_id, tile in shown.items()}
    return {tile_id: why for tile_id, why in sorted(tainted.items()) if why and tile_id not in planned}


def record_plan(workspace: Workspace, plan: CityPlan) -> None:
    """Let `presight status` say what the plan says."""
    tiles = [
        PlannedTile(
            tile.tile_id,
            "; ".join(tile.reasons),
            tile.recipe.digest if tile.recipe else "",
            len(tile.drive_ids),
            tile.frame_count,
        )
        for tile in plan.tiles
    ]
    tiles += [PlannedTile(tile_id, f"to be withdrawn: {why}", "", 0, 0) for tile_id, why in plan.withdrawn.items()]
    catalog = workspace.catalog()
    catalog.tile_states.save_plan(plan.city, tiles, catalog.now())


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


def _positions(workspace: Workspace, city: str, drives: tuple[Drive, ...], settings: CitySettings) -> DrivePositions:
    """Where the cameras were, of all frames that the settings let take part."""
    found = read_positions(workspace.drives(), city, [drive.drive_id for drive in drives])
    return found.select(found.is_keyframe) if settings.training.keyframes_only else found


def _members(frames: DrivePositions, city_tiling: Tiling, settings: CitySettings) -> list[Members]:
    """What trains each tile, as `tile_frames` says for one."""
    tiles = city_tiling.rows_within(frames.positions, settings.tiling.overlap_m)
    return [Members.of(frames, rows) for rows in tiles]


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


def _tiling(
    workspace: Workspace,
    city: str,
    frames: DrivePositions | None,
    generation: Generation | None,
    settings: CitySettings,
) -> Tiling:
    """The city's frozen tiling, with new tiles founded on new ground; the first one if there is none."""
    frozen = workspace.catalog().tiling(city)
    if frames is None:
        assert generation is not None
        return frozen or Tiling.from_json(generation.tiling)
    if frozen is None:
        return tiling.cut_city(city, frames.positions, settings.tiling)
    known = () if settings.tiling.tile_count is None else _cut_from(workspace, city)
    return tiling.extend_tiling(frozen, frames.positions, settings.tiling, known)


def _cut_from(workspace: Workspace, city: str) -> NDArray[np.float64]:
    """Camera positions (N, 3) of the drives that were there when the city's tiling was cut, world metres."""
    catalog, index = workspace.catalog(), workspace.drives()
    cut_at = catalog.tiling_created_at(city) or ""
    positions = [np.empty((0, 3))]
    for record in catalog.drive_records(city):
        if record.added_at <= cut_at:
            with suppress(NotFoundError):  # a removed drive whose index was cleared
                positions.append(index.positions(record.drive.drive_id)[0])
    return np.concatenate(positions)
