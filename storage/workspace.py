"""A workspace: the one folder that holds the catalog, the caches and the prior store, or says where they are."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from presight_core.config import WorkspaceSettings, load_workspace_settings
from presight_core.errors import NotFoundError

if TYPE_CHECKING:  # each part is imported when it is first used, so that `presight status` starts fast
    from storage.artifacts import Artifacts
    from storage.catalog import Catalog
    from storage.drives import DriveIndex
    from storage.features import FeatureCache
    from storage.priors import PriorStore


@dataclass(frozen=True)
class Workspace:
    """Names every place that a build reads or writes."""

    root: Path
    settings: WorkspaceSettings

    @staticmethod
    def open(root: Path) -> "Workspace":
        """The workspace at `root`, which need not exist yet. Raises SettingsError for a bad `presight.toml`."""
        root = root.absolute()
        return Workspace(root, load_workspace_settings(root / "presight.toml"))

    def require(self) -> "Workspace":
        """This workspace, if something was ever ingested into it. Raises NotFoundError if not."""
        if self.settings.catalog is None and not self._catalog_file.exists():
            raise NotFoundError(
                f"{self.root}: no workspace here yet; run `presight ingest ROOT --version NAME`, or name another "
                "folder with --workspace or PRESIGHT_WORKSPACE"
            )
        return self

    @property
    def _catalog_file(self) -> Path:
        return self.root / "catalog.sqlite"

    @property
    def catalog_url(self) -> str:
        """SQLAlchemy URL of the catalog."""
        return self.settings.catalog or f"sqlite:///{self._catalog_file}"

    @property
    def store_location(self) -> str:
        """Folder or object-store URL of the prior store."""
        return self.settings.store or str(self.root / "store")

    @property
    def caches(self) -> Path:
        """Folder of frames, features, artifacts and scratch: all of it can be made again."""
        return Path(self.settings.caches) if self.settings.caches else self.root / "caches"

    def city_file(self, city: str) -> Path:
        """The city's settings file; need not exist."""
        return self.root / "cities" / f"{city}.toml"

    def scratch(self, city: str, tile_id: str, digest: str) -> Path:
        """Scratch folder of one tile's recipe: checkpoints, logs, pictures."""
        return self.caches / "scratch" / city / tile_id / digest

    def catalog(self) -> "Catalog":
        """The open catalog, made on first use."""
        from storage.catalog import Catalog

        if self.settings.catalog is None:
            self.root.mkdir(parents=True, exist_ok=True)
        return Catalog.open(self.catalog_url)

    def drives(self) -> "DriveIndex":
        """Frames of every ingested drive."""
        from storage.drives import DriveIndex

        return DriveIndex(self.caches / "drives")

    def features(self) -> "FeatureCache":
        """Label maps and features of every image."""
        from storage.features import FeatureCache

        return FeatureCache(self.caches / "features")

    def artifacts(self) -> "Artifacts":
        """Feature spaces."""
        from storage.artifacts import Artifacts

        return Artifacts(self.caches / "artifacts")

    def store(self) -> "PriorStore":
        """The prior store, for writing."""
        from storage.priors import PriorStore

        return PriorStore.open(self.store_location)
