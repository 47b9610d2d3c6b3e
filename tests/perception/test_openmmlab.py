"""The prior as a step of an OpenMMLab pipeline, whose libraries are stood in for by a small registry."""

import pickle
import sys
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from presight_core import frames
from presight_core.errors import InputError, MissingDependencyError, NotFoundError, SettingsError
from presight_perception.dataset import CityPriors, Place, PriorDataset, PriorSettings, merge
from presight_perception.openmmlab import LoadPrior, register_new, register_old
from presight_perception.voxelise import BevAugmentation, VoxelGrid, Voxels
from tests.perception.conftest import publish

GRID = VoxelGrid((-10.0, -6.0, -2.0), (10.0, 6.0, 6.0), (0.5, 0.5, 0.5))
BOX = {"pc_range": [*GRID.low_m, *GRID.high_m], "voxel_size": list(GRID.voxel_m)}
POSE = frames.planar_transform(2.0, -1.0, 0.4)


def results_at(world_from_ego: np.ndarray = POSE, **others: Any) -> dict[str, Any]:
    """Results as a nuScenes data set of mmdet3d starts them."""
    return {
        "location": "town",
        "ego2global_translation": world_from_ego[:3, 3].tolist(),
        "ego2global_rotation": frames.quaternion_from_rotation(world_from_ego[:3, :3]).tolist(),
        **others,
    }


def step(town, **settings: Any) -> LoadPrior:
    return LoadPrior(**{"store": str(town), "cities": {"town": 1}, **BOX, **settings})


def found(results: dict[str, Any]) -> Voxels:
    return Voxels(results["prior_voxels"], results["prior_voxels_coords"])


def expected(town, place: Place, settings: PriorSettings | None = None) -> Voxels:
    return PriorDataset(CityPriors(town, {"town": 1}), [place], settings or PriorSettings(GRID))[0].voxels


def assert_equal(ours: Voxels, theirs: Voxels):
    assert len(theirs.features) > 100
    np.testing.assert_array_equal(ours.coordinates, theirs.coordinates)
    np.testing.assert_allclose(ours.features, theirs.features, atol=1e-6)


class Registry:
    """Builds from a configuration as OpenMMLab's registries do."""

    def __init__(self) -> None:
        self.classes: dict[str, type] = {}

    def register_module(self, name: str | None = None, force: bool = False, module: type | None = None) -> None:
        assert module is not None
        if module.__name__ in self.classes and not force:
            raise KeyError(module.__name__)
        self.classes[name or module.__name__] = module

    def build(self, config: dict[str, Any]) -> Any:
        return self.classes[config["type"]](**{key: value for key, value in config.items() if key != "type"})


def stand_in(monkeypatch, module: str, registry: str) -> Registry:
    """A registry in a made-up module."""
    parts = module.split(".")
    for count in range(1, len(parts) + 1):
        monkeypatch.setitem(sys.modules, ".".join(parts[:count]), ModuleType(parts[count - 1]))
    setattr(sys.modules[module], registry, Registry())
    return getattr(sys.modules[module], registry)


@pytest.mark.parametrize(
    ("register", "module", "registry"),
    [(register_old, "mmdet.datasets.builder", "PIPELINES"), (register_new, "mmengine.registry", "TRANSFORMS")],
)
def test_a_registered_step_is_built_from_a_configuration(town, monkeypatch, register, module, registry):
    built_by = stand_in(monkeypatch, module, registry)
    register()
    register()  # a plugin may be imported twice
    built = built_by.build({"type": "LoadPrior", "store": str(town), "cities": {"town": 1}, **BOX})
    assert_equal(found(built(results_at())), expected(town, Place("town", POSE)))


@pytest.mark.parametrize(("register", "package"), [(register_old, "mmdet"), (register_new, "mmengine")])
def test_without_openmmlab_registering_names_the_cure(monkeypatch, register, package):
    monkeypatch.setitem(sys.modules, package, None)  # importing it fails, installed or not
    with pytest.raises(MissingDependencyError, match=f"{package}.*pip install"):
        register()


def test_the_step_keeps_the_rest_of_the_results(town):
    before = results_at(img="image")
    after = step(town)(dict(before))
    assert {key: after[key] for key in before} == before
    assert set(after) - set(before) == {"prior_voxels", "prior_voxels_coords"}


@pytest.mark.parametrize(
    ("keys", "results"),
    [
        ({}, {**results_at(), "ego2global_rotation": POSE[:3, :3].tolist()}),  # as StreamMapNet does
        ({"world_from_ego": "ego2global"}, {"location": "town", "ego2global": POSE.tolist()}),  # mmdet3d from 1.1
        ({"city": "map_location"}, {**results_at(), "map_location": "town"}),  # as MapTR does
        (  # as BEVDet does
            {
                "city": "curr.location",
                "world_from_ego": ["curr.ego2global_translation", "curr.ego2global_rotation"],
            },
            {"curr": results_at()},
        ),
    ],
)
def test_city_and_pose_are_found_where_data_sets_put_them(town, keys, results):
    assert_equal(found(step(town, result_keys=keys)(results)), expected(town, Place("town", POSE)))


def test_with_a_lidar_pose_the_grid_lies_in_the_lidars_frame(town):
    ego_from_lidar = frames.planar_transform(0.9, 0.0, -np.pi / 2)  # x to the right, as nuScenes mounts it
    ego_from_lidar[2, 3] = 1.8
    keys = {"ego_from_lidar": "lidar_points.lidar2ego"}
    results = results_at(lidar_points={"lidar2ego": ego_from_lidar.tolist()})
    assert_equal(found(step(town, result_keys=keys)(results)), expected(town, Place("town", POSE @ ego_from_lidar)))


@pytest.mark.parametrize(
    ("results", "augmentation"),
    [
        (
            {"rotate_bda": -20.0, "scale_bda": 1.05, "flip_dx": True, "flip_dy": False},
            BevAugmentation(np.deg2rad(-20.0), 1.05, flip_x=True),
        ),
        ({"flip_dx": torch.tensor(True)}, BevAugmentation(flip_x=True)),
        ({"flip_dy": True, "scale_bda": 0.9}, BevAugmentation(0.0, 0.9, flip_y=True)),
    ],
)
def test_voxels_are_augmented_as_an_earlier_step_says(town, results, augmentation):
    ahead = VoxelGrid((0.0, -8.0, -2.0), (14.0, 5.0, 6.0), (0.5, 0.5, 0.5))
    load = step(town, pc_range=[*ahead.low_m, *ahead.high_m])
    points = CityPriors(town, {"town": 1}).points(Place("town", POSE), ((-90.0, 90.0), (-90.0, 90.0), (-90.0, 90.0)))
    theirs = PriorSettings(ahead).voxels(points, augmentation, np.random.default_rng(0))
    assert_equal(found(load(results_at(**results))), theirs)


def test_an_augmentation_that_the_prior_cannot_follow_is_refused(town):
    results = results_at(transformation_3d_flow=["R", "S", "T"])
    with pytest.raises(InputError, match=r"\['R', 'S', 'T'\].*'rotate_bda'"):
        step(town)(dict(results))
    assert len(found(step(town)({**results, "rotate_bda": 10.0})).features) > 100


def test_the_samples_own_drive_is_left_out_by_name_or_by_id(town):
    whole, without = (expected(town, Place("town", POSE, drives)) for drives in ((), ("drive-1",)))
    load = step(town, result_keys={"drive": "scene_name"})
    assert len(without.features) < len(whole.features)
    assert_equal(found(load(results_at(scene_name="scene-0001"))), without)
    assert_equal(found(load(results_at(scene_name="drive-1"))), without)
    assert_equal(found(load(results_at(scene_name="scene-0009"))), whole)


def test_a_drop_is_drawn_anew_each_time_and_again_from_the_same_seed(town):
    load, results = step(town, drop={"greatest_share": 0.9}), results_at()
    torch.manual_seed(3)
    first, second = (found(load(results)).features for _ in range(2))
    torch.manual_seed(3)
    again = found(load(results)).features
    torch.manual_seed(3)
    other_seed = found(step(town, drop={"greatest_share": 0.9}, seed=1)(results)).features
    np.testing.assert_array_equal(again, first)
    assert len({len(first), len(second), len(other_seed)}) == 3
    torch.manual_seed(3)
    elsewhere = len(found(load(results_at(frames.planar_transform(2.0, -1.0, 0.41)))).features)  # as on another rank
    assert abs(elsewhere - len(first)) > 20


def test_a_whole_prior_can_be_dropped(town):
    voxels = found(step(town, drop={"whole_chance": 1.0})(results_at()))
    assert voxels.features.shape == (0, 12)
    assert voxels.coordinates.shape == (0, 3)


def test_a_prior_can_be_moved_by_another_error_of_position_each_time(town):
    load, exact = step(town, noise={"deviation_m": 0.4}), found(step(town)(results_at()))
    torch.manual_seed(3)
    moved = [found(load(results_at())) for _ in range(2)]
    for one, other in ((moved[0], exact), (moved[1], exact), (moved[0], moved[1])):
        assert not np.array_equal(one.coordinates, other.coordinates)


def test_without_features_a_voxel_has_four_channels(town):
    assert found(step(town, with_features=False)(results_at())).features.shape[1] == 4


def test_a_city_may_only_be_without_a_prior_if_the_settings_say_so(town):
    load = step(town, cities_without_prior=["village"])
    assert found(load(results_at(location="village"))).features.shape == (0, 12)
    with pytest.raises(InputError, match=r"in 'hamlet', but LoadPrior has \['town'\]"):
        load(results_at(location="hamlet"))


def test_a_missing_key_is_named(town):
    with pytest.raises(InputError, match=r"no 'ego2global_translation', only \['location'\]"):
        step(town)({"location": "town"})


def test_a_pose_of_another_form_is_refused(town):
    with pytest.raises(InputError, match=r"shapes \(3,\) and \(3,\); a pose is"):
        step(town)(results_at(ego2global_rotation=[0.0, 0.0, 0.4]))


@pytest.mark.parametrize(
    "wrong",
    [
        {"result_keys": {"town": "location"}},
        {"drop": {"share": 0.5}},
        {"pc_range": [-10, -10, 10, 10]},
        {"pc_range": [-10, -10, -2, 10, 10, 2.2]},
        {"pc_range": [10, -10, -2, -10, 10, 2]},
        {"voxel_size": [0.5, 0.5, 0]},
    ],
)
def test_settings_that_do_not_fit_are_refused_when_the_pipeline_is_built(town, wrong):
    with pytest.raises(SettingsError, match="LoadPrior"):
        step(town, **wrong)


def test_the_newest_generation_is_pinned_when_the_pipeline_is_built(tmp_path):
    publish(tmp_path, "build-1", None)
    load = step(tmp_path, cities={"town": None})
    publish(tmp_path, "build-2", 1, seed=5)
    assert load.priors.generations == {"town": 1}


def test_a_pinned_store_is_first_touched_by_the_first_sample(tmp_path):
    load = step(tmp_path / "absent")
    with pytest.raises(NotFoundError, match="no priors of town"):
        load(results_at())


def test_a_copy_by_pickle_does_the_same(town):
    load = step(town)
    load(results_at())
    copy = pickle.loads(pickle.dumps(load))  # noqa: S301
    assert len(pickle.dumps(load)) < 10_000  # bytes: no window travels to a worker
    assert_equal(found(copy(results_at())), found(load(results_at())))


@pytest.mark.parametrize("start", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_workers_load_what_one_process_loads(town, start):
    places = [results_at(frames.planar_transform(float(x), 0.0, 0.0)) for x in range(4)]
    loader = DataLoader(
        Mapped(places, step(town)), batch_size=2, collate_fn=list, num_workers=2, multiprocessing_context=start
    )
    for ours, place in zip((result for batch in loader for result in batch), places, strict=True):
        assert_equal(found(ours), found(step(town)(place)))


def test_a_window_is_read_once(town, monkeypatch):
    load = step(town)
    first = found(load(results_at()))
    monkeypatch.setattr(load.priors, "points", None)  # calling it would fail
    assert_equal(found(load(results_at())), first)


def test_samples_merge_into_one_batch(town):
    samples = [found(step(town)(results_at(frames.planar_transform(x, 0.0, 0.0)))) for x in (0.0, 5.0)]
    features, coordinates = merge([each.features for each in samples], [each.coordinates for each in samples])
    counts = [len(each.features) for each in samples]
    assert torch.bincount(coordinates[:, 0]).tolist() == counts
    np.testing.assert_array_equal(coordinates[counts[0] :, 1:], samples[1].coordinates)
    np.testing.assert_array_equal(features[: counts[0]], samples[0].features)


class Mapped(torch.utils.data.Dataset):
    """Results through one step, as an OpenMMLab data set with its pipeline."""

    def __init__(self, results: list[dict[str, Any]], load: LoadPrior) -> None:
        self.results, self.load = results, load

    def __len__(self) -> int:
        return len(self.results)

    def __getitem__(self, index: int) -> dict[str, Any]:
        return self.load(dict(self.results[index]))
