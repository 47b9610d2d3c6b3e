"""What a tile's training may begin with: the field that the tile has, or nothing.

The rules are in docs/decisions/013-warm-starts.md.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.staleness import Reason
from presight_core.config import CitySettings
from presight_core.errors import InputError, NotFoundError
from presight_core.field.files import read_sub_fields
from presight_core.recipes import WARM_START, Recipe, aim_of, digest_of
from presight_core.tiles import SubField
from storage.workspace import Workspace


@dataclass(frozen=True)
class Start:
    """How `presight update` begins a stale tile."""

    training: Recipe  # to follow
    steps: int  # to take; 0: the field is there, only its voxels are made anew
    why_cold: str = ""  # why it begins with nothing; empty: it goes on from the field that the tile has

    @property
    def is_warm(self) -> bool:
        """Whether the tile goes on from the field that it has."""
        return not self.why_cold


@dataclass(frozen=True)
class StaleTile:
    """What a plan knows of a stale tile."""

    city: str
    tile_id: str
    training: Recipe  # from nothing
    causes: tuple[Reason, ...]
    cameras_world: NDArray[np.float64]  # (N, 3) metres


def find_start(
    workspace: Workspace, tile: StaleTile, published: Mapping[str, Any] | None, settings: CitySettings
) -> Start:
    """How an update of the tile begins. `published` is the recipe of the build that is shown, None for none."""
    before = (published or {}).get("inputs", {}).get("training", {})
    folder = workspace.scratch(tile.city, tile.tile_id, digest_of(before)) / "field"
    steps = round(settings.update.warm_steps_share * settings.training.steps)
    try:
        sub_fields = read_sub_fields(folder)
    except (NotFoundError, InputError):
        why_cold = "its field is not in the caches" if published else "never built"
    else:
        if aim_of(before) == tile.training.to_json():
            return Start(Recipe(**before), 0)
        why_cold = _why_unlike(tile, before) or _why_outside(tile, sub_fields, settings)
    if not (why_cold or steps):
        why_cold = "update.warm_steps_share is 0"
    if why_cold:
        return Start(tile.training, settings.training.steps, why_cold)
    begun = {"training": digest_of(before), "drives": before["inputs"]["drives"], "steps": steps}
    return Start(replace(tile.training, inputs={**tile.training.inputs, WARM_START: begun}), steps)


def _why_unlike(tile: StaleTile, before: Mapping[str, Any]) -> str:
    """What forbids to go on from the published field: anything that happened but new drives."""
    if set(before["inputs"]["drives"]) - set(tile.training.inputs["drives"]):
        seen = "; ".join(cause.text for cause in tile.causes if cause.kind in ("drive removed", "drive changed"))
        return f"its field has seen what it may not: {seen}"
    inputs = {**before["inputs"], "drives": tile.training.inputs["drives"]}
    if aim_of({**before, "inputs": inputs}) != tile.training.to_json():
        return "; ".join(cause.text for cause in tile.causes if cause.kind != "drive added")
    return ""


def _why_outside(tile: StaleTile, sub_fields: Sequence[SubField], settings: CitySettings) -> str:
    """Whether too many cameras are where the field's grids are coarse; empty if not."""
    share, most = outside_share(tile.cameras_world, sub_fields), settings.update.max_outside
    if share <= most:
        return ""
    return f"{share:.0%} of the cameras are outside the boxes of its field, more than update.max_outside = {most:.0%}"


def outside_share(cameras_world: NDArray[np.float64], sub_fields: Sequence[SubField]) -> float:
    """Share of the cameras (N, 3) that lie in the box of no sub-field."""
    inside = np.zeros(len(cameras_world), np.bool_)
    for each in sub_fields:
        low, high = np.array(each.box_min_m), np.array(each.box_max_m)
        inside |= ((cameras_world >= low) & (cameras_world <= high)).all(-1)
    return 1 - float(inside.mean())
