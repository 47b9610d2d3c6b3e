"""Occupancy ground truth of Occ3D-nuScenes: gts/<scene>/<sample token>/labels.npz."""

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from presight_core.classes import OCC3D
from presight_core.errors import InputError, NotFoundError

OCCUPANCY_CLASSES = OCC3D
OCCUPIED_CLASSES = OCCUPANCY_CLASSES[:17]
DYNAMIC_CLASSES = OCCUPANCY_CLASSES[:11]  # the paper's grouping, with barriers and cones
STATIC_CLASSES = OCCUPANCY_CLASSES[11:17]
FREE = OCCUPANCY_CLASSES.index("free")

RANGE_LOW_M = (-40.0, -40.0, -1.0)  # ego frame at the lidar's time
RANGE_HIGH_M = (40.0, 40.0, 5.4)
VOXEL_M = 0.4


@dataclass(frozen=True)
class OccupancyTruth:
    """The class of every voxel around a vehicle, indexed x forward, y left, z up, and who saw it."""

    semantics: NDArray[np.uint8]  # (X, Y, Z) place in OCCUPANCY_CLASSES; 255 is unknown
    mask_camera: NDArray[np.bool_]  # (X, Y, Z)
    mask_lidar: NDArray[np.bool_]  # (X, Y, Z)


def read_occupancy(folder: Path, scene_name: str, sample_token: str) -> OccupancyTruth:
    """The truth of one sample, `folder` being the one that holds gts/.

    Raises NotFoundError if the file is absent, InputError if it is not what Occ3D writes.
    """
    file = folder / "gts" / scene_name / sample_token / "labels.npz"
    if not file.is_file():
        raise NotFoundError(f"{file} does not exist; unpack Occ3D's gts there, or check scene and token")
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as opened:
            arrays = [opened[name] for name in ("semantics", "mask_camera", "mask_lidar")]
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(f"{file} is not an Occ3D label file ({error}); download it again") from error
    semantics, mask_camera, mask_lidar = arrays
    if semantics.ndim != 3 or not semantics.shape == mask_camera.shape == mask_lidar.shape:
        shapes = ", ".join(str(array.shape) for array in arrays)
        raise InputError(f"{file}: arrays of {shapes}; all three must be (X, Y, Z); download it again")
    return OccupancyTruth(semantics.astype(np.uint8), mask_camera.astype(np.bool_), mask_lidar.astype(np.bool_))
