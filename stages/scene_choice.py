"""Which scenes of a data set to ingest: by name, and whether tests and nights are among them."""

from dataclasses import dataclass
from fnmatch import fnmatchcase

from presight_core.nuscenes_split import role_of
from stages.nuscenes import Scene


@dataclass(frozen=True)
class SceneChoice:
    """A scene is taken if it passes every test; by default all scenes are."""

    names: tuple[str, ...] = ()  # shell patterns, "scene-00*"; none: any name
    tests: bool = True  # False: leave out the test scenes of the paper's split
    nights: bool = True  # False: leave out scenes whose description says night, as the paper's priors do

    def takes(self, scene: Scene) -> bool:
        """Whether to ingest it. Raises InputError where tests are not wanted and the name does not tell."""
        if self.names and not any(fnmatchcase(scene.name, pattern) for pattern in self.names):
            return False
        if not self.tests and role_of(scene.name) == "test":
            return False
        return self.nights or "night" not in scene.description.lower()

    def __str__(self) -> str:
        parts = [f"named {' or '.join(self.names)}"] if self.names else []
        parts += [] if self.tests else ["outside the tests of the paper's split"]
        return ", ".join(parts + ([] if self.nights else ["not at night"]))
