"""A city of any size for `bench.scale`: real catalog, drive index and store; only voxels and images are missing."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flows.city import freeze
from flows.plan import CityPlan, plan_city, record_plan, space_key
from flows.reconcile import hold_city
from presight_core.config import CitySettings, load_city_settings
from presight_core.drives import Drive, FrameTable
from presight_core.feature_space import FeatureSpace
from presight_core.priors.documents import GenerationTile, TileEntry, tile_path
from presight_core.tiles import Tile, Tiling
from storage.location import open_store, put_once
from storage.workspace import Workspace

CITY = "largetown"
TILE_M = 1000.0  # side of a tile: the usual square kilometre
DRIVE_M = 200.0  # a nuScenes scene: 20 s at 10 m/s
CAMERAS = ("CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT")
KEYFRAMES = 40  # of a scene, two a second
CHANNELS = 64
SETTINGS = f'preset = "paper"\n[training]\nkeyframes_only = true\n[features]\nchannels = {CHANNELS}\n'


@dataclass(frozen=True)
class ScaleCity:
    """One city of `tiles` tiles in a square grid."""

    root: Path
    tiles: int
    catalog: str | None = None  # URL; SQLite in the workspace if not given

    @property
    def workspace(self) -> Workspace:
        """The workspace, opened anew."""
        return Workspace.open(self.root)

    @property
    def settings(self) -> CitySettings:
        """The city's settings."""
        return load_city_settings(self.workspace.city_file(CITY))

    def prepare(self) -> None:
        """Settings, tiling and feature space: what there is before the first drive."""
        file = self.workspace.city_file(CITY)
        file.parent.mkdir(parents=True)
        file.write_text(SETTINGS)
        if self.catalog:
            (self.root / "presight.toml").write_text(f'catalog = "{self.catalog}"\n')
        places = np.stack(np.divmod(np.arange(self.tiles), self._side), -1) * TILE_M + TILE_M / 2
        tiles = tuple(Tile(f"t{number:03d}", (float(x), float(y))) for number, (x, y) in enumerate(places))
        settings = self.settings.tiling.model_dump(mode="json")
        self.workspace.catalog().save_tiling(Tiling("scale", CITY, tiles), settings)
        random = np.random.default_rng(0)
        shapes = {"mean": 6, "components": (CHANNELS, 6), "low": CHANNELS, "high": CHANNELS, "explained": CHANNELS}
        arrays = {name: random.random(shape).astype(np.float32) for name, shape in shapes.items()}
        artifacts = self.workspace.artifacts()
        space_id = artifacts.save_space(FeatureSpace(**arrays, model_sha256="a" * 64))
        artifacts.pin_space(space_key(self.settings), space_id)

    def add_drives(self, first: int, count: int) -> None:
        """Take in drives by number, as ingest does once it has read their tables."""
        catalog, index = self.workspace.catalog(), self.workspace.drives()
        for number in range(first, first + count):
            frames = self.frames(number)
            drive_id = str(frames.drive_id[0])
            name, times = f"scene-{number:06d}", frames.timestamp_us
            place = (CITY, "/data", "v1.0-trainval", "2026-11-22")
            drive = Drive(drive_id, name, *place, len(frames), int(times.min()), int(times.max()))
            catalog.add_drive(drive, (), index.add(drive, frames, (), catalog.now()))

    def frames(self, number: int) -> FrameTable:
        """The keyframes of a drive: a straight street somewhere in the city."""
        random = np.random.default_rng(number)
        start, heading = random.uniform(0, self._side * TILE_M, 2), random.uniform(0, 2 * np.pi)
        along = np.linspace(0, DRIVE_M, KEYFRAMES)[:, None] * np.array([np.cos(heading), np.sin(heading)])
        count = KEYFRAMES * len(CAMERAS)
        poses = np.tile(np.eye(4), (count, 1, 1))
        poses[:, :2, 3] = np.tile(start + along, (len(CAMERAS), 1))
        times = np.tile(number * 20_000_000 + np.arange(KEYFRAMES) * 500_000, len(CAMERAS))
        cameras = np.repeat(CAMERAS, KEYFRAMES)
        return FrameTable(
            drive_id=np.full(count, f"{number:016x}"),
            camera=cameras,
            timestamp_us=times,
            path=np.array([f"samples/{camera}/{time}.jpg" for camera, time in zip(cameras, times, strict=True)]),
            file_bytes=np.full(count, 150_000),
            width_px=np.full(count, 1600, np.int32),
            height_px=np.full(count, 900, np.int32),
            intrinsics=np.tile(np.array([[1266.0, 0, 816], [0, 1266.0, 491], [0, 0, 1]]), (count, 1, 1)),
            world_from_camera=poses,
            is_keyframe=np.ones(count, np.bool_),
        )

    def plan(self) -> CityPlan:
        """What `presight plan` does."""
        plan = plan_city(self.workspace, CITY, self.settings)
        record_plan(self.workspace, plan)
        return plan

    def publish(self, plan: CityPlan, most: int | None = None) -> int:
        """Publish stale tiles, at most so many, with groups that have a name and no content; the generation."""
        workspace, store = self.workspace, self.workspace.store()
        with hold_city(workspace, CITY) as lease:
            freeze(workspace, plan, lease)
            tiles = {tile.tile_id: self._tile(plan, tile) for tile in plan.stale[:most]}
            return store.publish(CITY, tiles, plan.generation, plan.tiling.to_json(), lease.token)

    def _tile(self, plan: CityPlan, tile) -> GenerationTile:
        path = tile_path(tile.tile_id, f"build-{plan.generation or 0}")
        put_once(open_store(self.workspace.store_location), f"{CITY}/{path}/zarr.json", b"{}")
        place = (int(tile.tile_id[1:]) // self._side, int(tile.tile_id[1:]) % self._side)
        low, high = ([int((each + side) * TILE_M / 12.8) for each in place] for side in (0, 1))  # blocks of 12.8 m
        entry = TileEntry(
            path, "0" * 64, "0" * 64, 3_000_000, 200_000_000, 6_000, (*low, *high), plan.space_id or "", tile.drive_ids
        )
        names = {drive_id: plan.known.names[drive_id] for drive_id in tile.drive_ids}
        return GenerationTile(entry, tile.recipe.to_json(), {"metrics": {"psnr_db": 23.5}, "drive_names": names})

    @property
    def _side(self) -> int:
        return int(np.ceil(np.sqrt(self.tiles)))
