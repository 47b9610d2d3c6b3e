"""A toy city through everything that writes: ingest, lease, plan, tiling, groups, generation, catalog.

Only the arithmetic is left out: the voxels of a tile are made up from its name, so that the truth is known.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flows.acceptance import Built
from flows.city import Order, freeze, tile_jobs
from flows.ingest import ingest_root
from flows.plan import plan_city, record_plan, space_key
from flows.publication import publish
from flows.reconcile import hold_city, reconcile
from presight_core.config import load_city_settings
from presight_core.feature_space import FeatureSpace
from presight_core.priors.example import ExampleTile
from presight_core.priors.reader import PriorReader
from storage.tile_groups import TileName
from storage.workspace import Workspace
from tests.tiny_dataset import TinyDataset

CITY = "toytown"
VERSION = "v1.0-mini"
CHANNELS = 8
SETTINGS = """
preset = "demo"
[features]
channels = 8
[tiling]
tile_count = 2
overlap_m = 500.0
[validation]
min_voxels = 1
"""


@dataclass(frozen=True)
class ToyCity:
    """One workspace and the data that it ingests."""

    root: Path
    data: Path
    side_blocks: int = 4  # of each tile

    @property
    def workspace(self) -> Workspace:
        """The workspace, opened anew."""
        return Workspace.open(self.root)

    def prepare(self) -> None:
        """Write the data, the settings and the feature space: what is there before anything can fail."""
        TinyDataset(self.data, VERSION).write()
        workspace = self.workspace
        file = workspace.city_file(CITY)
        file.parent.mkdir(parents=True)
        file.write_text(SETTINGS)
        workspace.artifacts().pin_space(space_key(load_city_settings(file)), self.save_space(seed=0))

    def save_space(self, seed: int) -> str:
        """Keep a made-up feature space; its id."""
        random = np.random.default_rng(seed)
        shapes = {"mean": 6, "components": (CHANNELS, 6), "low": CHANNELS, "high": CHANNELS, "explained": CHANNELS}
        arrays = {name: random.random(shape).astype(np.float32) for name, shape in shapes.items()}
        return self.workspace.artifacts().save_space(FeatureSpace(**arrays, model_sha256="a" * 64))

    def groups(self) -> list[Path]:
        """The folders of all builds of tiles, finished or not."""
        return [folder for folder in (self.root / "store" / CITY / "tiles").glob("*/*") if folder.is_dir()]

    def ingest(self) -> None:
        """Take in the drives."""
        ingest_root(self.root, self.data, VERSION, keep_going=False, as_json=False)

    def build(
        self,
        wait: bool = False,
        overrides: tuple[str, ...] = (),
        warm: bool = False,
        accept: tuple[str, ...] = (),
    ) -> int | None:
        """Build and publish what is stale, as the flows do; the generation."""
        workspace = self.workspace
        settings = load_city_settings(workspace.city_file(CITY), overrides)
        reconcile(workspace, CITY)
        with hold_city(workspace, CITY, wait) as lease:
            plan = plan_city(workspace, CITY, settings)
            record_plan(workspace, plan)
            if plan.is_current:
                return plan.generation
            if plan.stale:
                freeze(workspace, plan, lease)
            jobs = tile_jobs(workspace, plan, Order(str(self.root), CITY, warm=warm), lease)
            built = [self._written(workspace, job) for job in jobs.values()]
            return publish(workspace, plan, built, {}, lease, accept)["generation"]

    def example(self, tile_id: str) -> ExampleTile:
        """What the tile holds in truth."""
        return ExampleTile(side_blocks=self.side_blocks, channel_count=CHANNELS, drive_count=2, seed=int(tile_id[1:]))

    def check(self, allow_gaps: bool = False) -> dict[str, str]:
        """The digest of every tile that is shown. AssertionError if anything that is shown is not whole and true."""
        store = self.workspace.store()
        numbers = store.generations(CITY)
        assert allow_gaps or numbers == list(range(1, len(numbers) + 1)), f"the history has gaps: {numbers}"
        for number in numbers:
            self._check_generation(number)
        head = store.generation(CITY)
        return {tile_id: tile.entry.digest for tile_id, tile in head.tiles.items()} if head else {}

    def check_catalog(self) -> None:
        """AssertionError if the catalog says other than what is so, after a run that ended well."""
        catalog, index = self.workspace.catalog(), self.workspace.drives()
        drives = catalog.drives(CITY)
        assert drives == sorted(index.drives(), key=lambda drive: (drive.start_us, drive.drive_id))
        assert all(len(index.frames(drive.drive_id)) == drive.frame_count for drive in drives)
        assert catalog.running(CITY) == []
        shown = set(self.check())
        assert {build.tile_id for build in catalog.builds(CITY, "published")} == shown

    def _written(self, workspace: Workspace, job) -> Built:
        name = TileName(job.tile_id, f"build-{job.build_id}")
        attributes = {"recipe": job.recipe, "space_id": job.space_id}
        batches = replace(self.example(job.tile_id), drive_count=len(job.drive_ids)).batches()
        entry = workspace.store().write_tile(job.city, name, batches, sorted(job.drive_ids), attributes)
        return Built(job, {"metrics": {"psnr_db": 20.0}}, {"entry": entry.to_json(), "counts": {}, "seconds": 0.0})

    def _check_generation(self, number: int) -> None:
        reader = PriorReader.open(self.root / "store", CITY, number)
        for tile_id in reader.tiles:
            table, batches = reader.tile(tile_id), list(self.example(tile_id).batches())
            for name in ("block_index", "observed", "voxel", "centroid", "features", "hits", "density", "rgb"):
                truth = np.concatenate([getattr(batch, name) for batch in batches])
                np.testing.assert_array_equal(table.all_rows(name), truth, err_msg=f"{number} {tile_id} {name}")
