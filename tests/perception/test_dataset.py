"""From places to batches of voxels."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from presight_core import frames
from presight_core.errors import InputError
from presight_core.priors import PriorReader
from presight_perception.dataset import (
    AugmentationRange,
    CityPriors,
    Place,
    PointCache,
    PositionNoise,
    PriorDataset,
    PriorPoints,
    PriorSettings,
    collate,
)
from presight_perception.voxelise import BevAugmentation, VoxelDrop, VoxelGrid, voxelise
from storage.priors import PriorStore
from tests.perception.conftest import publish

GRID = VoxelGrid((-10.0, -6.0, -2.0), (10.0, 6.0, 6.0), (0.5, 0.5, 0.5))
PLACES = [Place("town", frames.planar_transform(2.0 * number, -number, 0.4 * number)) for number in range(4)]
EVERYWHERE = ((-90.0, 90.0), (-90.0, 90.0), (-90.0, 90.0))
TRAINING = PriorSettings(
    grid=GRID,
    augmentation=AugmentationRange(rotation_rad=0.4, scale=(0.9, 1.1), flips=True),
    drop=VoxelDrop(),
    noise=PositionNoise(0.5),
)


def dataset_of(town, settings: PriorSettings | None = None, places: list[Place] | None = None) -> PriorDataset:
    return PriorDataset(CityPriors(town, {"town": 1}), places or PLACES, settings or PriorSettings(GRID))


def assert_equal_batches(found, expected):
    for ours, theirs in zip(found, expected, strict=True):
        for part, other in zip(ours, theirs, strict=True):
            torch.testing.assert_close(part, other, rtol=0, atol=0)


def test_voxels_are_those_of_the_readers_window(town):
    place = PLACES[1]
    low_high = list(zip(GRID.low_m, GRID.high_m, strict=True))
    reader = PriorReader.open(town, "town")
    window = reader.window(place.world_from_ego, *low_high)
    weights = window.hits / reader.tile("t000").all_rows("hits").mean()
    expected = voxelise(window.points_ego, window.features / 255, weights, GRID)
    found, augmentation = dataset_of(town)[1]
    assert len(found.features) > 100
    np.testing.assert_array_equal(found.coordinates, expected.coordinates)
    np.testing.assert_allclose(found.features, expected.features, atol=1e-6)
    assert augmentation == BevAugmentation()


@pytest.mark.parametrize("range_", [TRAINING.augmentation, AugmentationRange(flips=True), AugmentationRange(3.0)])
def test_the_windows_margin_fills_the_augmented_grid(town, range_):
    dataset = dataset_of(town, PriorSettings(VoxelGrid((-6.0, -5.0, -2.0), (8.0, 4.0, 6.0), (0.5,) * 3), True, range_))
    for index in range(len(dataset)):
        voxels, augmentation = dataset[index]
        points = dataset.priors.points(PLACES[index], EVERYWHERE)
        turned = points.points_ego.astype(np.float64) @ augmentation.matrix.T
        expected = voxelise(turned, points.features / 255, points.weights, dataset.settings.grid)
        np.testing.assert_array_equal(voxels.coordinates, expected.coordinates)


def test_without_augmentation_the_window_is_the_grid():
    assert PriorSettings(GRID).window_ranges() == ((-10.0, 10.0), (-6.0, 6.0), (-2.0, 6.0))


@pytest.mark.parametrize("start", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_workers_draw_what_a_single_process_draws(town, start):
    dataset = dataset_of(town, replace(TRAINING, cache_bytes=0))  # so that workers read, after this process has
    alone = list(DataLoader(dataset, batch_size=2, collate_fn=collate))
    loader = DataLoader(
        dataset, batch_size=2, collate_fn=collate, num_workers=2, multiprocessing_context=start, persistent_workers=True
    )
    assert_equal_batches(list(loader), alone)
    dataset.set_epoch(1)
    assert_equal_batches(list(loader), list(DataLoader(dataset, batch_size=2, collate_fn=collate)))


def test_each_epoch_draws_anew(town):
    dataset = dataset_of(town, TRAINING)
    first = dataset[0]
    dataset.set_epoch(1)
    assert dataset[0].augmentation != first.augmentation
    dataset.set_epoch(0)
    np.testing.assert_array_equal(dataset[0].voxels.features, first.voxels.features)


def test_a_later_generation_does_not_change_a_pinned_dataset(tmp_path):
    publish(tmp_path, "build-1", None)
    dataset = dataset_of(tmp_path)
    before = dataset[0].voxels
    publish(tmp_path, "build-2", 1, seed=5)
    resumed = pickle.loads(pickle.dumps(dataset))  # noqa: S301
    np.testing.assert_array_equal(resumed[0].voxels.features, before.features)
    assert resumed.priors.generations == {"town": 1}
    assert CityPriors(tmp_path, {"town": None}).generations == {"town": 2}


def test_a_place_without_a_city_has_no_voxels(town):
    voxels, _ = dataset_of(town, places=[Place(None, np.eye(4))])[0]
    assert voxels.features.shape == (0, 3 + 8 + 1)
    assert voxels.coordinates.shape == (0, 3)


def test_a_city_that_was_not_opened_is_an_error(town):
    with pytest.raises(InputError, match=r"'village' was not opened, only \['town'\]"):
        dataset_of(town, places=[Place("village", np.eye(4))])[0]


def test_cities_of_different_feature_spaces_do_not_mix(tmp_path):
    publish(tmp_path, "build-1", None)
    store = PriorStore.open(tmp_path)
    reader = PriorReader.open(tmp_path, "town")
    store.create_city("village", reader.lattice, "space-2", reader.channel_count)
    store.publish("village", {}, None, {"tiling_id": "tiling-2", "city": "village", "tiles": []})
    with pytest.raises(InputError, match="different feature spaces"):
        CityPriors(tmp_path, {"town": None, "village": None})


def test_drives_left_out_take_their_own_voxels_along(town):
    whole, without = (
        dataset_of(town, places=[replace(PLACES[0], without_drives=drives)])[0].voxels
        for drives in ((), ("drive-0", "drive-2"))
    )
    assert 0.4 < len(without.features) / len(whole.features) < 0.75  # 4 of 7 drive sets hold drive-1


def test_without_features_a_voxel_has_four_channels(town):
    voxels, _ = dataset_of(town, PriorSettings(GRID, with_features=False))[0]
    assert voxels.features.shape[1] == 4


def test_each_noise_shifts_points_as_it_says():
    paper = PositionNoise(0.5).draw(np.random.default_rng(3))
    released = PositionNoise(0.5, "released").draw(np.random.default_rng(3))
    assert paper[0] != paper[1]
    assert paper[2] == 0
    assert len(set(released)) == 1
    shifts = [PositionNoise(0.5).draw(np.random.default_rng(seed))[0] for seed in range(2000)]
    assert np.std(shifts) == pytest.approx(0.5, rel=0.1)


def test_a_window_is_read_once(town, monkeypatch):
    dataset = dataset_of(town, TRAINING)
    first = dataset[0]
    monkeypatch.setattr(dataset.priors, "points", None)  # calling it would fail
    np.testing.assert_array_equal(dataset[0].voxels.features, first.voxels.features)


def test_the_cache_stays_within_its_bytes_and_forgets_what_was_not_used():
    points = PriorPoints(np.zeros((10, 3), np.float32), np.zeros((10, 4), np.uint8), np.zeros(10, np.float32))
    cache = PointCache(2 * 200)  # bytes; each entry has 200
    for key in (0, 1):
        cache.put(key, points)
    assert cache.get(0) is points
    cache.put(2, points)
    assert cache.size_bytes == 400
    assert cache.get(1) is None
    assert cache.get(0) is cache.get(2) is points


def test_an_entry_larger_than_the_cache_is_not_kept():
    points = PriorPoints(np.zeros((10, 3), np.float32), np.zeros((10, 4), np.uint8), np.zeros(10, np.float32))
    cache = PointCache(100)
    cache.put(0, points)
    assert cache.get(0) is None
    assert cache.size_bytes == 0


def test_a_batch_numbers_its_samples(town):
    samples = [dataset_of(town)[index] for index in (0, 2)]
    batch = collate(samples)
    counts = torch.bincount(batch.coordinates[:, 0]).tolist()
    assert counts == [len(sample.voxels.features) for sample in samples]
    np.testing.assert_array_equal(batch.coordinates[counts[0] :, 1:], samples[1].voxels.coordinates)
    np.testing.assert_array_equal(batch.voxels[: counts[0]], samples[0].voxels.features)
    torch.testing.assert_close(batch.augmentations, torch.eye(3).expand(2, 3, 3))
