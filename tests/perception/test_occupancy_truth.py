"""Occ3D's files."""

import numpy as np
import pytest

from presight_core.errors import InputError, NotFoundError
from presight_perception.occupancy_truth import (
    DYNAMIC_CLASSES,
    FREE,
    OCCUPANCY_CLASSES,
    RANGE_HIGH_M,
    RANGE_LOW_M,
    STATIC_CLASSES,
    VOXEL_M,
    read_occupancy,
)


def write(folder, **arrays) -> None:
    target = folder / "gts" / "scene-0001" / "abc"
    target.mkdir(parents=True)
    np.savez_compressed(target / "labels.npz", **arrays)


def test_labels_are_read_as_written(tmp_path):
    semantics = np.arange(24, dtype=np.uint8).reshape(2, 3, 4) % 18
    write(tmp_path, semantics=semantics, mask_camera=semantics % 2, mask_lidar=semantics % 3)
    truth = read_occupancy(tmp_path, "scene-0001", "abc")
    np.testing.assert_array_equal(truth.semantics, semantics)
    np.testing.assert_array_equal(truth.mask_camera, semantics % 2 == 1)
    np.testing.assert_array_equal(truth.mask_lidar, semantics % 3 > 0)


def test_absent_labels_are_named(tmp_path):
    with pytest.raises(NotFoundError, match=r"scene-0001/abc/labels.npz does not exist"):
        read_occupancy(tmp_path, "scene-0001", "abc")


@pytest.mark.parametrize("missing", ["semantics", "mask_lidar"])
def test_a_file_without_an_array_is_an_error(tmp_path, missing):
    arrays = {name: np.zeros((2, 2, 2)) for name in ("semantics", "mask_camera", "mask_lidar") if name != missing}
    write(tmp_path, **arrays)
    with pytest.raises(InputError, match="not an Occ3D label file"):
        read_occupancy(tmp_path, "scene-0001", "abc")


def test_a_cut_file_is_an_error(tmp_path):
    write(tmp_path, semantics=np.zeros((2, 2, 2)))
    file = tmp_path / "gts" / "scene-0001" / "abc" / "labels.npz"
    file.write_bytes(file.read_bytes()[:50])
    with pytest.raises(InputError, match="not an Occ3D label file"):
        read_occupancy(tmp_path, "scene-0001", "abc")


def test_masks_of_another_shape_are_an_error(tmp_path):
    write(tmp_path, semantics=np.zeros((2, 2, 2)), mask_camera=np.zeros((2, 2)), mask_lidar=np.zeros((2, 2, 2)))
    with pytest.raises(InputError, match=r"must be \(X, Y, Z\)"):
        read_occupancy(tmp_path, "scene-0001", "abc")


def test_every_class_but_free_is_either_dynamic_or_static():
    assert (*DYNAMIC_CLASSES, *STATIC_CLASSES, "free") == OCCUPANCY_CLASSES
    assert FREE == 17
    assert (len(DYNAMIC_CLASSES), len(STATIC_CLASSES)) == (11, 6)


def test_the_range_is_200_by_200_by_16_voxels():
    np.testing.assert_allclose(np.subtract(RANGE_HIGH_M, RANGE_LOW_M) / VOXEL_M, [200, 200, 16])
