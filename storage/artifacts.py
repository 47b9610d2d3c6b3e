"""Artifacts that outlive a build: feature spaces, named by their content, and which one is in use.

<folder>/spaces/<space id>/space.safetensors, space.json    the numbers; the model, and figures for people
<folder>/pins/<digest>.json                                 the space that a choice of model and channels uses
"""

import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from presight_core.errors import NotFoundError, StoreError
from presight_core.feature_space import FeatureSpace
from presight_core.recipes import digest_of
from storage.folders import create_file, whole_folder

ARRAYS = tuple(field.name for field in fields(FeatureSpace) if field.name != "model_sha256")


class Artifacts:
    """Keeps feature spaces in a folder."""

    def __init__(self, folder: Path):
        self._folder = folder

    def save_space(self, space: FeatureSpace) -> str:
        """Keep a space and return its id; a space that is there already is left as it is."""
        from safetensors.numpy import save_file

        if not self.has_space(space.space_id):
            facts = {
                "space_id": space.space_id,
                "model_sha256": space.model_sha256,
                "channels": space.channel_count,
                "explained": round(float(space.explained.sum()), 6),
            }
            with whole_folder(self._space(space.space_id)) as temporary:
                # safetensors writes the memory as it lies, so that it must lie row by row
                arrays = {name: np.ascontiguousarray(getattr(space, name)) for name in ARRAYS}
                save_file(arrays, temporary / "space.safetensors")
                (temporary / "space.json").write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")
        return space.space_id

    def has_space(self, space_id: str) -> bool:
        """Whether the space is kept here."""
        return (self._space(space_id) / "space.json").is_file()

    def space(self, space_id: str) -> FeatureSpace:
        """The kept space. Raises NotFoundError if there is none, StoreError if it is not what its id says."""
        from safetensors import SafetensorError
        from safetensors.numpy import load_file

        folder = self._space(space_id)
        if not self.has_space(space_id):
            raise NotFoundError(f"no feature space {space_id} in {self._folder}; run `presight build` to fit one")
        try:
            facts = json.loads((folder / "space.json").read_text(encoding="utf-8"))
            arrays = load_file(folder / "space.safetensors")
            space = FeatureSpace(**{name: arrays[name] for name in ARRAYS}, model_sha256=facts["model_sha256"])
        except (OSError, ValueError, KeyError, SafetensorError) as error:
            raise _damaged(folder, f"cannot be read ({error})") from error
        if space.space_id != space_id:
            raise _damaged(folder, f"its content has the id {space.space_id}")
        return space

    def pin_space(self, key: dict[str, Any], space_id: str) -> str:
        """Freeze which space a choice of model and channels (JSON) uses; returns the one pinned first."""
        file = self._pin(key)
        content = json.dumps({"key": key, "space_id": space_id}, indent=2) + "\n"
        create_file(file, content.encode())  # of two fits at once, one wins
        return self.pinned_space(key) or space_id

    def pinned_space(self, key: dict[str, Any]) -> str | None:
        """The id of the space that was pinned for this choice, if there is one."""
        file = self._pin(key)
        if not file.is_file():
            return None
        try:
            return str(json.loads(file.read_text(encoding="utf-8"))["space_id"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise _damaged(file, f"cannot be read ({error})") from error

    def _space(self, space_id: str) -> Path:
        return self._folder / "spaces" / space_id

    def _pin(self, key: dict[str, Any]) -> Path:
        return self._folder / "pins" / f"{digest_of(key)}.json"


def _damaged(path: Path, fact: str) -> StoreError:
    return StoreError(f"{path}: {fact}; restore it from a backup, or delete it and rebuild every tile")
