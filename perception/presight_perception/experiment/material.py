"""What experiments are made of: keyframes to train and to test on, and the priors around them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from presight_core.errors import InputError, NotFoundError
from presight_core.nuscenes_split import Role
from presight_core.priors import PriorReader
from presight_perception.dataset import CityPriors, Place, PriorDataset, PriorSettings, PriorSource
from presight_perception.experiment.keyframes import ImageSize, Keyframe, read_images, read_keyframes, rig_of
from presight_perception.experiment.runs import PriorKind, Probe, Run, digest
from presight_perception.lidar_history import LidarHistory
from presight_perception.models.camera_rig import CameraRig
from presight_perception.voxelise import VoxelGrid

WITHOUT_VOXELS: tuple[PriorKind, ...] = ("none", "nmp")
WITHOUT_FEATURES: tuple[PriorKind, ...] = ("geometry", "lidar")
GEOMETRY_CHANNELS = 4  # of a voxel: its place and its hits
AT_THE_VEHICLE_M = -5.0, 5.0
HEIGHTS_M = -3.0, 5.0
CACHE_BYTES = 1 << 30  # of prior windows a process: those of a thousand tiny samples


@dataclass(frozen=True)
class Locations:
    """Where everything is, and how much of it to take."""

    data: Path  # root of a data set in nuScenes format
    version: str
    store: str  # of the priors: folder or URL
    image_size: ImageSize = field(default_factory=ImageSize)
    test_stride: int = 2  # every so many-th keyframe of a test drive is tried: neighbours look alike
    colours_store: str | None = None  # of priors with the features `colours`


class Material:
    """The data of all runs: made once in each process."""

    def __init__(self, locations: Locations) -> None:
        """Raises InputError for a data set without training or test scenes of the paper's split."""
        self.locations = locations
        self.keyframes = read_keyframes(locations.data, locations.version)
        self.image = cache(self._image)
        self.groups_of = cache(self._groups_of)

    @cached_property
    def train(self) -> list[Keyframe]:
        """Keyframes of the training scenes."""
        return self._of_role("train")

    @cached_property
    def test(self) -> list[Keyframe]:
        """Some keyframes of each test scene."""
        stride, scenes = self.locations.test_stride, {}
        for keyframe in self._of_role("test"):
            scenes.setdefault(keyframe.scene, []).append(keyframe)
        return [keyframe for scene in scenes.values() for keyframe in scene[stride // 2 :: stride]]

    @cached_property
    def priors(self) -> CityPriors:
        """The priors of all cities that have one; cities without are driven without.

        Raises InputError if a test city has none.
        """
        return self._open(self.locations.store)

    @cached_property
    def colour_priors(self) -> CityPriors:
        """The same with features that nothing was learned for. Raises InputError also if no store of them is named."""
        if self.locations.colours_store is None:
            raise InputError(
                "no store has the features `colours`; build one with --set features.feature_model=colours in a "
                "workspace of its own, and name it: --colours-store WORKSPACE/store"
            )
        return self._open(self.locations.colours_store)

    def priors_of(self, kind: PriorKind) -> CityPriors:
        """What runs of a kind see, or a LiDAR history of the same drives is made for."""
        return self.colour_priors if kind == "colours" else self.priors

    @cached_property
    def lidar_history(self) -> LidarHistory:
        """What the lidar saw on the very drives that the priors were made from."""
        names = {name for drives in self.priors.drive_names.values() for name in drives.values() if name}
        return LidarHistory.from_tables(self.locations.data, self.locations.version, sorted(names))

    @property
    def digest(self) -> str:
        """Names the keyframes and how they are read; the priors' own name is `prior_digest`."""
        tokens = [keyframe.token for keyframe in [*self.train, *self.test]]
        return digest(tokens, self.locations.image_size, self.locations.test_stride)

    def prior_digest(self, kind: PriorKind) -> str:
        """Names the prior that runs of a kind see."""
        return "" if kind == "none" else digest(kind, self.priors_of(kind).builds)

    def voxel_channels(self, kind: PriorKind) -> int | None:
        """Channels of a prior's voxel; None for what has no voxels."""
        if kind in WITHOUT_VOXELS:
            return None
        return GEOMETRY_CHANNELS + (0 if kind in WITHOUT_FEATURES else self.priors_of(kind).channel_count)

    def online(self, keyframes: Sequence[Keyframe]) -> tuple[Tensor, CameraRig]:
        """Images (B, N, 3, H, W), 0 to 1, of some keyframes, and their rigs."""
        images = torch.stack([self.image(keyframe.token) for keyframe in keyframes])
        return images.float() / 255, rig_of(keyframes, self.locations.image_size)

    def earlier(self, keyframe: Keyframe) -> Keyframe:
        """The keyframe before, of the same scene; of the first one, itself."""
        row = self._row_of[keyframe.token]
        before = self.keyframes[row - 1]
        return before if row and before.scene == keyframe.scene else keyframe

    def training_prior(self, run: Run, grid: VoxelGrid) -> PriorDataset | None:
        """The prior's voxels around the training keyframes, each without its own drive; None if it has no voxels."""
        if run.prior in WITHOUT_VOXELS:
            return None
        settings = PriorSettings(
            grid, run.prior != "geometry", drop=run.drop, noise=run.noise, cache_bytes=CACHE_BYTES, seed=run.seed
        )
        return PriorDataset(self._source(run), [self._place(run, each, own=False) for each in self.train], settings)

    def is_mapped(self, keyframe: Keyframe) -> bool:
        """Whether the prior has anything where the vehicle stands."""
        place = Place(keyframe.city, keyframe.world_from_ego)
        return len(self.priors.points(place, (AT_THE_VEHICLE_M, AT_THE_VEHICLE_M, HEIGHTS_M)).points_ego) > 0

    def prior_drives(self, probe: Probe) -> list[Keyframe]:
        """The keyframes that the test cities' priors were made from, as far as a probe shows them."""
        cities = {keyframe.city for keyframe in self.test}
        return [
            keyframe
            for keyframe in self.keyframes
            if keyframe.city in cities and keyframe.scene in self._names(keyframe.city, probe.drives)
        ]

    def test_prior(self, run: Run, probe: Probe, grid: VoxelGrid) -> PriorDataset | None:
        """The prior's voxels around the test keyframes as a probe shows it; None if it has no voxels."""
        if run.prior in WITHOUT_VOXELS:
            return None
        settings = PriorSettings(grid, run.prior != "geometry", noise=probe.noise, seed=run.seed)
        return PriorDataset(
            self._source(run), [self._place(run, each, drives=probe.drives) for each in self.test], settings
        )

    def _source(self, run: Run) -> PriorSource:
        return self.lidar_history if run.prior == "lidar" else self.priors_of(run.prior)

    def _place(self, run: Run, keyframe: Keyframe, own: bool = True, drives: str = "all") -> Place:
        """Where a keyframe is, with its own drive in the prior or without, and with so many of the others."""
        priors = self.priors_of(run.prior)
        if keyframe.city not in priors.generations or drives == "none":
            return Place(None, keyframe.world_from_ego)
        names = priors.drive_names[keyframe.city]
        shown = self._names(keyframe.city, drives)
        hidden = [drive for drive, name in names.items() if name not in shown or (name == keyframe.scene and not own)]
        if run.prior == "lidar":  # which knows its drives by their names
            hidden = [names[drive] for drive in hidden]
        return Place(keyframe.city, keyframe.world_from_ego, tuple(hidden))

    def _names(self, city: str, drives: str) -> list[str]:
        """Scene names of all, every second or none of the drives in a city's prior."""
        names = sorted(set(self.priors.drive_names[city].values()))
        return {"all": names, "half": names[::2], "none": []}[drives]

    def _open(self, store: str) -> CityPriors:
        generations = {}
        for city in sorted({keyframe.city for keyframe in self.keyframes}):
            try:
                generations[city] = PriorReader.open(store, city).generation.number
            except NotFoundError:
                continue
        missing = {keyframe.city for keyframe in self.test} - generations.keys()
        if missing:
            raise InputError(
                f"{store} has no prior of {', '.join(sorted(missing))}; "
                f"build it: presight ingest {self.locations.data} --no-tests --no-nights, then presight build CITY"
            )
        return CityPriors(store, generations)

    def _of_role(self, role: Role) -> list[Keyframe]:
        chosen = [keyframe for keyframe in self.keyframes if keyframe.role == role]
        if not chosen:
            raise InputError(
                f"{self.locations.data}: no {role} scene of the paper's split; make one with "
                "presight synth OUT --preset experiment"
            )
        return chosen

    def _groups_of(self, token: str) -> tuple[str, ...]:
        """What a test keyframe's figures count for: all, day or night, and whether the prior saw this ground."""
        keyframe = self.keyframes[self._row_of[token]]
        return (
            "all",
            "night" if keyframe.is_night else "day",
            "mapped ground" if self.is_mapped(keyframe) else "new ground",
        )

    def _image(self, token: str) -> Tensor:
        return read_images(self.keyframes[self._row_of[token]], self.locations.image_size)

    @cached_property
    def _row_of(self) -> dict[str, int]:
        return {keyframe.token: row for row, keyframe in enumerate(self.keyframes)}


def spread(keyframes: Sequence[Keyframe], count: int) -> list[int]:
    """Places of some keyframes, evenly over all."""
    return np.linspace(0, len(keyframes) - 1, min(count, len(keyframes))).round().astype(int).tolist()
