"""The prior around each sample's vehicle as voxels: read once, cached, augmented, collated."""

from collections import OrderedDict
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional
from torch.utils.data import Dataset

from presight_core.errors import InputError
from presight_core.priors import PriorReader
from presight_perception.voxelise import MAPPING_GRID, BevAugmentation, VoxelDrop, VoxelGrid, Voxels, voxelise

Range = tuple[float, float]

NOISE_REACH = 3.0  # standard deviations that the window's margin covers


@dataclass(frozen=True)
class Place:
    """Where a sample's vehicle is."""

    city: str | None  # None: there is no prior here, and the sample gets no voxels
    world_from_ego: NDArray[np.float64]  # (4, 4) at the lidar's time, metres
    without_drives: tuple[str, ...] = ()  # left out of the prior: in training, the drive that the sample is from


@dataclass(frozen=True)
class AugmentationRange:
    """What a sample's augmentation is drawn from, evenly."""

    rotation_rad: float = 0.0  # either way
    scale: Range = (1.0, 1.0)
    flips: bool = False  # each with a chance of one half

    def draw(self, random: np.random.Generator) -> BevAugmentation:
        """One augmentation; always takes four numbers from `random`."""
        turn, scale, flip_x, flip_y = random.random(4)
        return BevAugmentation(
            rotation_rad=(2 * turn - 1) * self.rotation_rad,
            scale=self.scale[0] + scale * (self.scale[1] - self.scale[0]),
            flip_x=bool(self.flips and flip_x < 0.5),
            flip_y=bool(self.flips and flip_y < 0.5),
        )


@dataclass(frozen=True)
class PositionNoise:
    """A wrong position of the vehicle: the paper's form shifts the pose in x and y (Table 6).

    The released code's form adds one number to x, y and z of every point alike.
    """

    deviation_m: float = 0.0
    form: Literal["paper", "released"] = "paper"

    def draw(self, random: np.random.Generator) -> NDArray[np.float64]:
        """The shift (3,) of the points, ego metres."""
        x, y = random.normal(0.0, 1.0, 2) * self.deviation_m
        return np.array([x, y, 0.0] if self.form == "paper" else [x, x, x])


class PriorPoints(NamedTuple):
    """The prior's points in a window, before augmentation."""

    points_ego: NDArray[np.float32]  # (N, 3) metres
    features: NDArray[np.uint8]  # (N, C) 255 = 1.0
    weights: NDArray[np.float32]  # (N,) hits over the generation's mean hits: one scale for all cities

    @staticmethod
    def none(channel_count: int) -> "PriorPoints":
        """No points, of so many channels."""
        features = np.zeros((0, channel_count), np.uint8)
        return PriorPoints(np.zeros((0, 3), np.float32), features, np.zeros(0, np.float32))


@dataclass(frozen=True)
class PriorSettings:
    """How a place becomes voxels."""

    grid: VoxelGrid = MAPPING_GRID
    with_features: bool = True  # False: position and hits alone, 4 channels
    augmentation: AugmentationRange = field(default_factory=AugmentationRange)
    drop: VoxelDrop | None = None  # for training
    noise: PositionNoise = field(default_factory=PositionNoise)
    cache_bytes: int = 256 << 20  # in each worker process: about a hundred windows of a street
    seed: int = 0

    def window_ranges(self) -> tuple[Range, Range, Range]:
        """The box of the ego frame, x, y and z in metres, of which any augmentation and noise fills the grid."""
        (x_low, y_low, z_low), (x_high, y_high, z_high) = self.grid.low_m, self.grid.high_m
        turn, flips = self.augmentation.rotation_rad, self.augmentation.flips
        if turn or flips:
            x_half, y_half = max(-x_low, x_high), max(-y_low, y_high)
            x_high, y_high = _turned(x_half, y_half, turn), _turned(y_half, x_half, turn)
            x_low, y_low = -x_high, -y_high
        margin = NOISE_REACH * self.noise.deviation_m
        enlarged = 1 / self.augmentation.scale[0]
        x, y, z = (
            (min(low, low * enlarged) - margin, max(high, high * enlarged) + margin)
            for low, high in ((x_low, x_high), (y_low, y_high), (z_low, z_high))
        )
        return x, y, z

    def voxels(self, points: PriorPoints, augmentation: BevAugmentation, random: np.random.Generator) -> Voxels:
        """The voxels of the points in `window_ranges` under an augmentation, which must lie in the settings' range."""
        points_ego = (points.points_ego + self.noise.draw(random)) @ augmentation.matrix.T
        voxels = voxelise(points_ego, points.features if self.with_features else None, points.weights, self.grid)
        return voxels if self.drop is None else self.drop.apply(voxels, random)

    @staticmethod
    def none(channel_count: int) -> "PriorPoints":
        """No points, of so many channels."""
        features = np.zeros((0, channel_count), np.uint8)
        return PriorPoints(np.zeros((0, 3), np.float32), features, np.zeros(0, np.float32))


class PriorSource(Protocol):
    """Where priors come from: `CityPriors`, or a kind to compare with, such as `LidarHistory`. Can be pickled."""

    @property
    def channel_count(self) -> int:
        """Feature channels of a point."""
        ...

    def points(self, place: Place, ranges: tuple[Range, Range, Range]) -> PriorPoints:
        """The prior in a box around a place; none where its city is None."""
        ...


class PriorSample(NamedTuple):
    """One sample's voxels, and how they were augmented: turn the targets and online features alike."""

    voxels: Voxels
    augmentation: BevAugmentation


class PriorBatch(NamedTuple):
    """A batch for `PriorFusion2D` and `PriorFusion3D`."""

    voxels: Tensor  # (V, 4 + C) of all samples
    coordinates: Tensor  # (V, 4) int64 sample, x, y, z
    augmentations: Tensor  # (B, 3, 3) float32; new points = points @ matrix.T


class CityPriors:
    """Readers of several cities at pinned generations. Can be pickled; after a fork it reads folders, not URLs."""

    def __init__(self, location: str | Path, generations: Mapping[str, int | None]) -> None:
        """Open cities in a store at the given generations, None being the newest now.

        Raises NotFoundError for a city or generation that is not there, StoreError for what cannot be read,
        InputError for cities of different feature spaces.
        """
        self._readers = {city: PriorReader.open(location, city, number) for city, number in generations.items()}
        spaces = {city: reader.space_id for city, reader in self._readers.items()}
        if len(set(spaces.values())) > 1:
            raise InputError(f"the cities have different feature spaces: {spaces}; build them with one feature space")
        self._mean_hits = {city: _mean_hits(reader) for city, reader in self._readers.items()}

    @property
    def generations(self) -> dict[str, int]:
        """The generation of each city: store it with a checkpoint, and open the same ones when resuming."""
        return {city: reader.generation.number for city, reader in self._readers.items()}

    @property
    def channel_count(self) -> int:
        """Feature channels of a point; 0 without any city."""
        return max((reader.channel_count for reader in self._readers.values()), default=0)

    @property
    def space_id(self) -> str:
        """The feature space of all cities; "" without any city."""
        return next((reader.space_id for reader in self._readers.values()), "")

    @property
    def drive_names(self) -> dict[str, dict[str, str]]:
        """Of each city, the scene names of the drives in its prior by their ids, which `without_drives` takes."""
        return {city: reader.drive_names for city, reader in self._readers.items()}

    @property
    def builds(self) -> dict[str, list[str]]:
        """Of each city, the digests of its tiles' contents: equal ones mean equal priors."""
        return {
            city: sorted(tile.entry.digest for tile in reader.generation.tiles.values())
            for city, reader in self._readers.items()
        }

    def drive_ids(self, city: str, name: str) -> tuple[str, ...]:
        """Ids of a city's drives that have this scene name; none if its prior was made without it."""
        return tuple(drive for drive, its_name in self._reader(city).drive_names.items() if its_name == name)

    def points(self, place: Place, ranges: tuple[Range, Range, Range]) -> PriorPoints:
        """The prior in a box around a place. Raises InputError for a city that was not opened."""
        if place.city is None:
            return PriorPoints.none(self.channel_count)
        window = self._reader(place.city).window(place.world_from_ego, *ranges, without_drives=place.without_drives)
        weights = (window.hits / self._mean_hits[place.city]).astype(np.float32)
        return PriorPoints(window.points_ego, window.features, weights)

    def _reader(self, city: str) -> PriorReader:
        if city not in self._readers:
            raise InputError(f"{city!r} was not opened, only {sorted(self._readers)}; name it in `generations`")
        return self._readers[city]


class PriorDataset(Dataset[PriorSample]):
    """Voxels of each place. What is drawn depends on seed, epoch and index alone, not on workers or their number."""

    def __init__(self, priors: PriorSource, places: Sequence[Place], settings: PriorSettings | None = None) -> None:
        self.priors = priors
        self.settings = settings or PriorSettings()
        self._places = places
        self._ranges = self.settings.window_ranges()
        self._epoch = torch.zeros(1, dtype=torch.int64).share_memory_()  # workers that stay alive see it change
        self._cache = PointCache(self.settings.cache_bytes)

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> PriorSample:
        random = np.random.default_rng([self.settings.seed, int(self._epoch), index])
        augmentation = self.settings.augmentation.draw(random)
        return PriorSample(self.voxels(index, augmentation, random), augmentation)

    def set_epoch(self, epoch: int) -> None:
        """Draw anew: call it before each epoch, as of a distributed sampler."""
        self._epoch[0] = epoch

    def voxels(self, index: int, augmentation: BevAugmentation, random: np.random.Generator) -> Voxels:
        """The voxels of one place under a given augmentation, which must lie in the settings' range."""
        points = self._cache.get(index)
        if points is None:
            points = self.priors.points(self._places[index], self._ranges)
            self._cache.put(index, points)
        return self.settings.voxels(points, augmentation, random)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_cache": PointCache(self.settings.cache_bytes)}


class PointCache:
    """The most recently used windows, of at most so many bytes."""

    def __init__(self, limit_bytes: int) -> None:
        self._limit_bytes = limit_bytes
        self._entries: OrderedDict[Hashable, PriorPoints] = OrderedDict()
        self.size_bytes = 0

    def get(self, key: Hashable) -> PriorPoints | None:
        """What was put under a key, if it is still there."""
        if key in self._entries:
            self._entries.move_to_end(key)
        return self._entries.get(key)

    def put(self, key: Hashable, points: PriorPoints) -> None:
        """Keep points of a new key, at the cost of the least recently used ones."""
        self._entries[key] = points
        self.size_bytes += _size_bytes(points)
        while self.size_bytes > self._limit_bytes:
            self.size_bytes -= _size_bytes(self._entries.popitem(last=False)[1])


def collate(samples: Sequence[PriorSample]) -> PriorBatch:
    """One batch of samples, for a DataLoader's collate_fn."""
    voxels, coordinates = merge(
        [sample.voxels.features for sample in samples], [sample.voxels.coordinates for sample in samples]
    )
    matrices = np.stack([sample.augmentation.matrix for sample in samples])
    return PriorBatch(voxels, coordinates, torch.from_numpy(matrices.astype(np.float32)))


def merge(
    features: Sequence[Tensor | NDArray], coordinates: Sequence[Tensor | NDArray], device: torch.device | None = None
) -> tuple[Tensor, Tensor]:
    """The voxels and coordinates of a `PriorBatch` from those of each sample, (V, 4 + C) and (V, 3) x, y, z."""
    numbered = [
        functional.pad(torch.as_tensor(rows, dtype=torch.int64, device=device), (1, 0), value=number)
        for number, rows in enumerate(coordinates)
    ]
    return torch.cat([torch.as_tensor(rows, device=device) for rows in features]), torch.cat(numbered)


def _turned(half: float, other_half: float, turn: float) -> float:
    """How far a rectangle of half sides `half` and `other_half` reaches along the first when turned by up to `turn`."""
    angle = min(turn, np.arctan2(other_half, half))  # where a corner points along the axis, it reaches farthest
    return float(half * np.cos(angle) + other_half * np.sin(angle))


def _mean_hits(reader: PriorReader) -> float:
    hits = [reader.tile(tile_id).all_rows("hits") for tile_id in reader.tiles]
    count = sum(len(column) for column in hits)
    return sum(float(column.sum(dtype=np.float64)) for column in hits) / count if count else 1.0


def _size_bytes(points: PriorPoints) -> int:
    return sum(column.nbytes for column in points)
