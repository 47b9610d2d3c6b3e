"""Why a tile is stale, in words: how its published recipe differs from the one of today."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from flows.drives import CityDrives
from presight_core.errors import NotFoundError, StoreError
from presight_core.recipes import aim_of, differences
from storage.drives import DriveIndex

Kind = Literal[
    "never built", "drive added", "drive removed", "drive changed", "setting", "model", "code version", "other"
]

FEATURES = "inputs.features."
MOVING = {"inputs.moving.margin": "features.dynamic_margin", "inputs.moving.shadows": "features.mask_shadows"}
MOVING["inputs.dynamic_classes"] = "features.dynamic_classes"
STAGES = {"version": "extraction", "inputs.training.version": "training"}
STAGES["inputs.training.inputs.features.version"] = "features"


@dataclass(frozen=True)
class Reason:
    """One reason for a tile to be stale."""

    kind: Kind
    text: str


def stale_reasons(
    published: Mapping[str, Any] | None, today: Mapping[str, Any] | None, known: CityDrives, index: DriveIndex
) -> tuple[Reason, ...]:
    """What makes a tile stale; nothing if its published recipe is that of today.

    `published` is None for a tile that is not shown, `today` while there is no feature space.
    """
    if published is None:
        return (Reason("never built", "never built"),)
    if today is None:
        return (Reason("model", "the feature space is not fitted"),)
    lines = [tuple(line.split(": ", 1)) for line in differences(aim_of(published), aim_of(today))]
    drives = [change.rsplit(" ", 1) for path, change in lines if path == "inputs.training.inputs.drives"]
    others = [_reason(path, change) for path, change in lines if path != "inputs.training.inputs.drives"]
    added = [drive_id for drive_id, what in drives if what == "added"]
    removed = [drive_id for drive_id, what in drives if what == "removed"]
    return tuple(dict.fromkeys([*_drive_reasons(added, removed, known, index), *others]))


def _reason(path: str, change: str) -> Reason:
    if path in STAGES:
        return Reason("code version", f"code version of {STAGES[path]}: {change}")
    path = path.removeprefix("inputs.training.")
    if path.startswith(f"{FEATURES}inputs."):
        return Reason("model", f"model changed: {path.removeprefix(f'{FEATURES}inputs.')}: {change}")
    if path.startswith(f"{FEATURES}settings."):
        name = path.removeprefix(f"{FEATURES}settings.")
        section = "training" if name == "keyframes_only" else "features"  # both stages heed it; said once
        return Reason("setting", f"setting {section}.{name}: {change}")
    if path in MOVING:
        return Reason("setting", f"setting {MOVING[path]}: {change}")
    if path.startswith("settings."):
        return Reason("setting", f"setting {path.removeprefix('settings.')}: {change}")
    return Reason("other", f"{path}: {change}")


def _drive_reasons(added: list[str], removed: list[str], known: CityDrives, index: DriveIndex) -> list[Reason]:
    """Drives that came, went, or were replaced by a corrected one of the same name."""
    name = {drive_id: known.names.get(drive_id, drive_id) for drive_id in [*added, *removed]}
    came = {name[drive_id]: drive_id for drive_id in added}
    went = {name[drive_id]: drive_id for drive_id in removed}
    reasons = [Reason("drive added", f"drive {each} added") for each in came if each not in went]
    for each, drive_id in went.items():
        if each in came:
            reasons.append(Reason("drive changed", f"drive {each} {how_changed(index, drive_id, came[each])}"))
        else:
            gone = f"drive {each} has no frame here any more"
            reasons.append(Reason("drive removed", known.barred.get(drive_id, gone)))
    return reasons


def how_changed(index: DriveIndex, old_id: str, new_id: str) -> str:
    """What is new of a drive that was ingested again: "re-posed by up to 1.20 m"."""
    try:
        old, new = index.frames(old_id), index.frames(new_id)
    except (NotFoundError, StoreError):  # the caches were cleared
        return "was ingested anew with other content"
    if len(old) != len(new):
        return f"was ingested anew: {len(old)} -> {len(new)} frames"
    if np.array_equal(old.world_from_camera, new.world_from_camera):
        return "was ingested anew with other images, times or calibration"
    return f"re-posed, by up to {np.linalg.norm(new.positions - old.positions, axis=-1).max():.2f} m"
