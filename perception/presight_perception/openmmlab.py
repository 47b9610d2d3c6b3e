"""The prior as one step of an OpenMMLab data pipeline, old (`PIPELINES`) or new (`TRANSFORMS`).

`LoadPrior` is a plain class that maps a results dict to a results dict. Only `register_old` and `register_new`
import OpenMMLab.
"""

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import import_module
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from presight_core.errors import InputError, MissingDependencyError, SettingsError
from presight_core.priors import PriorReader
from presight_perception.dataset import (
    AugmentationRange,
    CityPriors,
    Place,
    PointCache,
    PositionNoise,
    PriorPoints,
    PriorSettings,
)
from presight_perception.voxelise import MAPPING_GRID, BevAugmentation, VoxelDrop, VoxelGrid

Results = dict[str, Any]
PoseKey = str | Sequence[str]  # of a 4 x 4 matrix, or two: of a translation, and of a rotation (w, x, y, z or 3 x 3)


@dataclass(frozen=True)
class ResultKeys:
    """Where `LoadPrior` finds things in the results, and where it puts them; "curr.location" is a key inside "curr"."""

    city: str = "location"
    world_from_ego: PoseKey = ("ego2global_translation", "ego2global_rotation")  # at the lidar's time
    ego_from_lidar: PoseKey | None = None  # given: the grid lies in the lidar's frame instead of the ego frame
    drive: str | None = None  # scene name or drive id of the sample's own drive, which the prior is then read without
    rotation_deg: str = "rotate_bda"  # these four as BEVDet's augmentation leaves them; absent means not augmented
    scale: str = "scale_bda"
    flip_x: str = "flip_dx"
    flip_y: str = "flip_dy"
    voxels: str = "prior_voxels"  # float32 (V, 4 + C)
    coordinates: str = "prior_voxels_coords"  # int32 (V, 3) x, y, z


@dataclass
class LoadPrior:
    """Adds the voxels of the prior around each sample to the results, augmented as an earlier step augmented the rest.

    Takes plain values, so that a configuration file can hold them. Raises SettingsError for values that do not fit,
    and what `CityPriors` raises when the first sample is read, in each worker process.
    """

    store: str  # folder or URL
    cities: Mapping[str, int | None]  # generation of each city; None: the newest when the pipeline is built
    pc_range: Sequence[float] = (*MAPPING_GRID.low_m, *MAPPING_GRID.high_m)  # least x, y, z, greatest x, y, z, metres
    voxel_size: Sequence[float] = MAPPING_GRID.voxel_m
    with_features: bool = True  # False: position and hits alone, 4 channels
    drop: Mapping[str, float] | None = None  # for training: the fields of `VoxelDrop`
    noise: Mapping[str, Any] | None = None  # for training: the fields of `PositionNoise`
    result_keys: Mapping[str, Any] = field(default_factory=dict)  # fields of `ResultKeys` unlike its defaults
    cities_without_prior: Sequence[str] = ()  # whose samples get no voxels, where other cities are an error
    cache_bytes: int = PriorSettings.cache_bytes  # of windows, in each worker process
    seed: int = 0  # besides torch's own, which each worker's generator has

    def __post_init__(self) -> None:
        try:
            self._keys = ResultKeys(**self.result_keys)
            drop = None if self.drop is None else VoxelDrop(**self.drop)
            noise = PositionNoise(**(self.noise or {}))
        except TypeError as error:
            names = "ResultKeys, VoxelDrop and PositionNoise"
            raise SettingsError(f"LoadPrior: {error}; see {names} for the names") from error
        self._settings = PriorSettings(self._grid(), self.with_features, drop=drop, noise=noise)
        self._generations = {
            city: PriorReader.open(self.store, city).generation.number if number is None else number
            for city, number in self.cities.items()
        }
        self._cache = PointCache(self.cache_bytes)

    def __call__(self, results: Results) -> Results:
        """The same results, and voxels and coordinates. Raises InputError for an entry that is absent or wrong."""
        place, augmentation = self._place(results), self._augmentation(results)
        sides = AugmentationRange(
            rotation_rad=abs(augmentation.rotation_rad),
            scale=(augmentation.scale, augmentation.scale),
            flips=augmentation.flip_x or augmentation.flip_y,
        )
        settings = replace(self._settings, augmentation=sides)  # whose window fills this sample's grid, and no more
        voxels = settings.voxels(self._points(place, settings), augmentation, self._random(place))
        results |= {self._keys.voxels: voxels.features, self._keys.coordinates: voxels.coordinates}
        return results

    @cached_property
    def priors(self) -> CityPriors:
        """The open priors."""
        return CityPriors(self.store, self._generations)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_cache": PointCache(self.cache_bytes)}

    def _grid(self) -> VoxelGrid:
        box, size = [float(value) for value in self.pc_range], [float(value) for value in self.voxel_size]
        if len(box) != 6 or len(size) != 3 or not _is_whole(np.array(box[3:]) - box[:3], np.array(size)):
            raise SettingsError(
                f"LoadPrior: pc_range {box} is not a box of whole voxels of {size} m; give least x, y, z and "
                "greatest x, y, z, and the size of a voxel along x, y, z"
            )
        return VoxelGrid((box[0], box[1], box[2]), (box[3], box[4], box[5]), (size[0], size[1], size[2]))

    def _place(self, results: Results) -> Place:
        keys = self._keys
        world_from_grid = _transform(results, keys.world_from_ego)
        if keys.ego_from_lidar is not None:
            world_from_grid = world_from_grid @ _transform(results, keys.ego_from_lidar)
        city = _entry(results, keys.city)
        if city in self.cities_without_prior:
            return Place(None, world_from_grid)
        if city not in self.cities:
            raise InputError(
                f"a sample is in {city!r}, but LoadPrior has {list(self.cities)}; add it to cities, or to "
                "cities_without_prior if it shall have no voxels"
            )
        drive = () if keys.drive is None else (_entry(results, keys.drive),)
        named = [drive_id for name in drive for drive_id in self.priors.drive_ids(city, name)]
        return Place(city, world_from_grid, (*drive, *named))

    def _augmentation(self, results: Results) -> BevAugmentation:
        keys = self._keys
        foreign = results.get("transformation_3d_flow")  # the names of mmdet3d's own augmentations, if any was drawn
        if foreign and keys.rotation_deg not in results:
            raise InputError(
                f"mmdet3d augmented the sample ({foreign}), which the prior cannot follow; leave that step out, or let "
                f"it write {keys.rotation_deg!r}, {keys.scale!r}, {keys.flip_x!r} and {keys.flip_y!r}"
            )
        return BevAugmentation(
            rotation_rad=float(np.deg2rad(results.get(keys.rotation_deg, 0.0))),
            scale=float(results.get(keys.scale, 1.0)),
            flip_x=bool(results.get(keys.flip_x, False)),
            flip_y=bool(results.get(keys.flip_y, False)),
        )

    def _points(self, place: Place, settings: PriorSettings) -> PriorPoints:
        ranges = settings.window_ranges()
        key = (place.city, place.world_from_ego.tobytes(), place.without_drives, ranges)
        points = self._cache.get(key)
        if points is None:
            points = self.priors.points(place, ranges)
            self._cache.put(key, points)
        return points

    def _random(self, place: Place) -> np.random.Generator:
        """What torch's generator draws makes each call differ; the place, the samples of ranks with the same seed."""
        drawn = int(torch.randint(1 << 62, ()))
        return np.random.default_rng([self.seed, drawn, zlib.crc32(place.world_from_ego.tobytes())])


def register_old() -> None:
    """Let mmdet 2 and mmdet3d up to 1.0 build `dict(type="LoadPrior", ...)`. Raises MissingDependencyError."""
    _register("mmdet.datasets.builder", "PIPELINES", 'pip install "mmdet<3", or call register_new for newer OpenMMLab')


def register_new() -> None:
    """Let mmengine, mmdet 3 and mmdet3d from 1.1 build `dict(type="LoadPrior", ...)`. Raises MissingDependencyError."""
    _register("mmengine.registry", "TRANSFORMS", "pip install mmengine, or call register_old for older OpenMMLab")


def _register(module: str, registry: str, cure: str) -> None:
    try:
        found = getattr(import_module(module), registry)
    except ImportError as error:
        raise MissingDependencyError(f"{module} cannot be imported: {error}; {cure}") from error
    found.register_module(module=LoadPrior, force=True)  # again is harmless


def _is_whole(sides_m: NDArray[np.float64], voxel_m: NDArray[np.float64]) -> bool:
    if not np.all(voxel_m > 0):
        return False
    counts = np.round(sides_m / voxel_m)
    return bool(np.all(counts >= 1) and np.allclose(counts * voxel_m, sides_m))


def _entry(results: Results, key: str) -> Any:
    value: Any = results
    for part in key.split("."):
        if not isinstance(value, Mapping) or part not in value:
            raise InputError(
                f"the results hold no {key!r}, only {list(results)}; name the right one in LoadPrior's result_keys"
            )
        value = value[part]
    return value


def _transform(results: Results, key: PoseKey) -> NDArray[np.float64]:
    """A transform (4, 4) from the results."""
    if isinstance(key, str):
        return np.asarray(_entry(results, key), np.float64)
    translation, rotation = (np.asarray(_entry(results, part), np.float64) for part in key)
    if translation.shape != (3,) or rotation.shape not in {(4,), (3, 3)}:
        raise InputError(
            f"{list(key)} of the results have the shapes {translation.shape} and {rotation.shape}; "
            "a pose is a translation (3,) and a quaternion w, x, y, z or a matrix (3, 3)"
        )
    a_from_b = np.eye(4)
    a_from_b[:3, :3] = rotation if rotation.ndim == 2 else Rotation.from_quat(rotation, scalar_first=True).as_matrix()
    a_from_b[:3, 3] = translation
    return a_from_b
