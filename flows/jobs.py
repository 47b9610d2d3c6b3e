"""Jobs: one stage of one tile or drive, described by references only, so that any process can do it."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from presight_core.config import CitySettings, validate
from presight_core.drives import FrameTable
from presight_core.errors import ConflictError
from presight_core.recipes import Recipe
from presight_core.tiles import Tiling
from storage.workspace import Workspace


@dataclass(frozen=True)
class Job:
    """What a worker process needs to know; everything else it looks up in the workspace."""

    workspace: str
    city: str
    build_id: int  # catalog row that progress is written to
    settings: dict[str, Any]  # CitySettings as JSON values
    threads: int = 1
    device: str = "cpu"
    space_id: str = ""
    features_recipe: dict[str, Any] = field(default_factory=dict)
    drive_ids: tuple[str, ...] = ()
    tiling_id: str = ""
    tile: int = 0  # index in the tiling
    tile_id: str = ""
    training_recipe: dict[str, Any] = field(default_factory=dict)
    recipe: dict[str, Any] = field(default_factory=dict)

    @property
    def opened_tiling(self) -> Tiling:
        """The city's tiling. Raises ConflictError if it is not the one that the job was made for."""
        tiling = self.opened_workspace.catalog().tiling(self.city)
        if tiling is None or tiling.tiling_id != self.tiling_id:
            raise ConflictError(f"{self.city}: its tiles were cut anew since this build began; build it again")
        return tiling

    @property
    def opened_settings(self) -> CitySettings:
        """The city's settings."""
        return validate(CitySettings, self.settings, "job")

    @property
    def opened_workspace(self) -> Workspace:
        """The workspace that the job reads and writes."""
        return Workspace.open(Path(self.workspace))

    @property
    def scratch(self) -> Path:
        """Where the tile's training keeps its checkpoints, logs and pictures."""
        return self.opened_workspace.scratch(self.city, self.tile_id, recipe_from(self.training_recipe).digest)

    @property
    def features_key(self) -> str:
        """The feature cache's key."""
        return recipe_from(self.features_recipe).digest

    def frames(self) -> FrameTable:
        """The frames that train the tile, ordered by drive."""
        from flows.plan import drive_frames, tile_frames

        index, settings = self.opened_workspace.drives(), self.opened_settings
        frames = FrameTable.concatenate([drive_frames(index, drive_id, settings) for drive_id in self.drive_ids])
        return tile_frames(frames, self.opened_tiling, self.tile, settings)

    def to_json(self) -> str:
        """The job as text."""
        return json.dumps(asdict(self))

    @staticmethod
    def from_json(text: str) -> "Job":
        """The job that `to_json` wrote."""
        values = json.loads(text)
        return Job(**{**values, "drive_ids": tuple(values["drive_ids"])})


def recipe_from(value: dict[str, Any]) -> Recipe:
    """The recipe that `Recipe.to_json` wrote."""
    return Recipe(value["stage"], value["version"], value["settings"], value["inputs"])
