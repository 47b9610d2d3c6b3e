"""Experiments: what is trained, what is shown when a model is tried, and that work is done once."""

import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from presight_core.errors import InputError
from presight_core.frames import planar_transform
from presight_perception.dataset import PositionNoise, PriorDataset
from presight_perception.experiment.keyframes import ImageSize, lidar_depth, read_images, read_keyframes, rig_of
from presight_perception.experiment.material import Locations, Material
from presight_perception.experiment.report import table_of, write_report
from presight_perception.experiment.runner import Job, Outcome, do_job, do_rows, running
from presight_perception.experiment.runs import LINE_MODELS, Probe, Run, Schedule
from presight_perception.experiment.tables import TABLES, Row, Scope, rows_of
from presight_perception.experiment.tasks import MapTask, task_of
from presight_perception.experiment.trained_models import build_model, run_folder, trained_model
from presight_perception.experiment.training import batch_rows, epoch_of
from presight_perception.experiment.trial import Trial, constant_mask_figures
from tests.perception import toy_dataset
from tests.perception.conftest import publish

SIZE = ImageSize(32, 64)
SCHEDULE = Schedule(steps=3, batch_size=2)
WITH_PRIOR = Run("raster", "presight", schedule=SCHEDULE)


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    """Threads cost these tiny models more than they give."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def locations(tmp_path_factory) -> Locations:
    folder = tmp_path_factory.mktemp("experiment")
    publish(folder / "store", "build-1", None, drive_names={"drive-0": toy_dataset.TRAIN_SCENE})
    data = toy_dataset.write_dataset(folder / "data")
    return Locations(data, toy_dataset.VERSION, str(folder / "store"), SIZE, test_stride=1)


@pytest.fixture(scope="module")
def material(locations: Locations) -> Material:
    return Material(locations)


def edit(root: Path, table: str, change: Callable[[list[dict]], None]) -> None:
    file = root / toy_dataset.VERSION / f"{table}.json"
    rows = json.loads(file.read_text())
    change(rows)
    file.write_text(json.dumps(rows))


def test_a_keyframe_stands_where_the_vehicle_was_at_the_lidars_time(material: Material) -> None:
    np.testing.assert_allclose([each.world_from_ego[0, 3] for each in material.train], [0, 2, 4, 6])
    assert [each.is_night for each in material.keyframes] == [True] * 4 + [False] * 4
    # The camera fired later, farther on: in the ego frame of the lidar's time it sits that much ahead.
    np.testing.assert_allclose(material.train[1].ego_from_camera[0, :3, 3], [toy_dataset.LATE_M, 0, 1.5], atol=1e-9)


def test_a_rig_follows_its_images_to_their_new_size(material: Material) -> None:
    keyframe = material.train[0]
    images, rig = read_images(keyframe, SIZE), rig_of([keyframe], SIZE)
    assert images.shape == (6, 3, 32, 64)
    assert images.dtype == torch.uint8
    places = rig.project(torch.tensor([20.0, 0.0, 1.5]), (32, 64))
    np.testing.assert_allclose(places.places[0, 1], [0.5, 0.5], atol=1e-6)  # straight ahead: the front camera's middle
    assert places.seen[0].tolist() == [False, True, False, False, False, False]


def test_a_missing_image_is_named_with_the_cure(tmp_path: Path) -> None:
    keyframe = read_keyframes(toy_dataset.write_dataset(tmp_path / "data"), toy_dataset.VERSION)[0]
    keyframe.images[2].unlink()
    with pytest.raises(InputError, match=r"CAM_FRONT_RIGHT.*missing, or no image; extract"):
        read_images(keyframe, SIZE)


def test_a_row_that_leads_nowhere_is_named_with_its_table(tmp_path: Path) -> None:
    root = toy_dataset.write_dataset(tmp_path / "data")
    edit(root, "ego_pose", lambda rows: rows.pop())
    with pytest.raises(InputError, match=r"ego_pose\.json: no row has the token 'scene-0001-3-LIDAR_TOP'"):
        read_keyframes(root, toy_dataset.VERSION)


def test_a_data_set_without_test_scenes_is_refused(tmp_path: Path, locations: Locations) -> None:
    root = toy_dataset.write_dataset(tmp_path / "data")
    edit(root, "scene", lambda rows: rows[1].update(name="scene-0063"))
    with pytest.raises(InputError, match="no test scene of the paper's split; make one with presight synth"):
        Material(Locations(root, toy_dataset.VERSION, locations.store)).test  # noqa: B018


def test_a_test_city_without_prior_is_refused_with_the_commands_that_build_it(
    tmp_path: Path, locations: Locations
) -> None:
    without = Locations(locations.data, locations.version, str(tmp_path / "empty"))
    with pytest.raises(InputError, match=r"has no prior of town; build it: presight ingest .* presight build CITY"):
        Material(without).priors  # noqa: B018


def test_a_training_keyframe_does_not_see_its_own_drive_in_the_prior(material: Material) -> None:
    task = task_of("raster", material.locations)
    run = Run("raster", "presight", drop=type(WITH_PRIOR.drop)(greatest_share=0.0))
    trained = material.training_prior(run, task.prior_grid)[0].voxels  # pyright: ignore - it has voxels
    tried = material.test_prior(run, Probe(), task.prior_grid)[0].voxels  # pyright: ignore - the same place
    assert 0 < len(trained.features) < len(tried.features)


def test_probes_show_what_they_say_of_the_prior(material: Material) -> None:
    task = task_of("raster", material.locations)

    def voxels(probe: Probe) -> torch.Tensor:
        return Trial(torch.nn.Identity(), WITH_PRIOR, probe, task, material).prior([0, 1]).coordinates

    everything = voxels(Probe())
    assert 0 < len(voxels(Probe(drives="half"))) < len(everything)
    assert len(voxels(Probe(drives="none"))) == 0
    assert not torch.equal(voxels(Probe(noise=PositionNoise(1.0))), everything)
    mirrored = voxels(Probe(mirrored=True))
    mirrored[:, 2] = task.prior_grid.shape[1] - 1 - mirrored[:, 2]
    assert {*map(tuple, mirrored.tolist())} == {*map(tuple, everything.tolist())}


def test_zeroed_cameras_change_what_a_model_finds(material: Material) -> None:
    task = task_of("raster", material.locations)
    model = trained_model(WITH_PRIOR, task, material, material.locations.data / "run", lambda _: None)
    heads = [Trial(model, WITH_PRIOR, Probe(cameras=cameras), task, material) for cameras in (True, False)]
    logits = []
    model.decode = lambda found: logits.append(found) or list(found)  # pyright: ignore
    for trial in heads:
        trial.found([0])
    assert not torch.allclose(*logits)


def test_lidar_returns_lie_on_the_pixels_that_see_them(material: Material, tmp_path: Path) -> None:
    keyframe = material.train[0]
    assert keyframe.sweep is not None
    ego_from_lidar = keyframe.sweep.ego_from_lidar
    ahead = np.linalg.inv(ego_from_lidar) @ [10.5, -0.1, 1.4, 1.0]  # ego; the cameras are half a metre farther on
    file = tmp_path / "sweep.pcd.bin"
    behind = np.linalg.inv(ego_from_lidar) @ [20.5, -0.2, 1.3, 1.0]  # on the same pixel
    np.array([[*behind[:3], 0, 0], [*ahead[:3], 0, 0]], "<f4").tofile(file)
    depth = lidar_depth(replace(keyframe, sweep=replace(keyframe.sweep, file=file)), SIZE)
    assert depth is not None
    assert np.flatnonzero(depth[1]).tolist() == [16 * 64 + 32]  # of the front camera: next to the middle
    np.testing.assert_allclose(depth[1, 16, 32], 10.0, atol=1e-5)
    assert not depth[4].any()  # the back camera's


def test_an_occupancy_model_is_given_the_keyframe_before(material: Material) -> None:
    task = task_of("bevdet-occ", material.locations)
    (past,) = task.more_inputs(material.train[:2], material)["history"]
    np.testing.assert_allclose(past.past_from_now[:, 0, 3], [0.0, toy_dataset.STEP_M])  # the first has none before
    np.testing.assert_allclose(past.age_s, [0.0, 0.5])
    torch.testing.assert_close(past.images[1], material.online(material.train[:1])[0][0])


def test_every_epoch_sees_each_sample_once_in_another_order() -> None:
    schedule = Schedule(batch_size=3)
    epochs = [[row for step in range(first, first + 2) for row in batch_rows(schedule, 0, 6, step)] for first in (0, 2)]
    assert [sorted(epoch) for epoch in epochs] == [list(range(6))] * 2
    assert epochs[0] != epochs[1]


def test_an_interrupted_training_ends_as_an_uninterrupted_one(
    material: Material, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("presight_perception.experiment.training.CHECKPOINT_STEPS", 1)
    monkeypatch.setattr("presight_perception.experiment.training.REPORT_STEPS", 1)
    task = task_of("raster", material.locations)

    def stop(progress) -> None:
        if progress.done == 3:
            raise KeyboardInterrupt

    whole = trained_model(WITH_PRIOR, task, material, tmp_path / "whole", lambda _: None)
    with pytest.raises(KeyboardInterrupt):
        trained_model(WITH_PRIOR, task, material, tmp_path / "broken", stop)
    seen: list[int] = []
    resumed = trained_model(WITH_PRIOR, task, material, tmp_path / "broken", lambda each: seen.append(each.done))
    assert seen == [3]
    for name, weight in whole.state_dict().items():
        torch.testing.assert_close(resumed.state_dict()[name], weight)


def test_a_model_with_a_map_of_its_own_remembers_the_prior_drives(material: Material, tmp_path: Path) -> None:
    run, task = Run("raster", "nmp", schedule=SCHEDULE), task_of("raster", material.locations)
    assert [each.scene for each in material.prior_drives(Probe())] == [toy_dataset.TRAIN_SCENE] * 4
    model = trained_model(run, task, material, tmp_path, lambda _: None)
    found: list[torch.Tensor] = []
    model.decode = lambda logits: found.append(logits) or list(logits)  # pyright: ignore
    for probe in (Probe(), Probe(drives="none")):
        Trial(model, run, probe, task, material).found([0])
    assert not torch.allclose(*found)


def test_a_line_model_learns_on_the_view_of_a_raster_mapper_which_it_keeps(material: Material, tmp_path: Path) -> None:
    run = Run("stream", "presight", schedule=SCHEDULE, masks=SCHEDULE)
    stages: list[str] = []
    task = task_of("stream", material.locations)
    model = trained_model(run, task, material, tmp_path, lambda each: stages.append(each.stage))
    assert run.teacher == WITH_PRIOR
    assert list(dict.fromkeys(stages)) == [WITH_PRIOR.title, f"{run.title}, bird's-eye views", run.title]
    teacher = trained_model(WITH_PRIOR, task, material, tmp_path, lambda _: None).state_dict()
    untrained = build_model(run, material).state_dict()
    for name, weight in model.state_dict().items():
        if name.startswith("bev."):
            torch.testing.assert_close(weight, teacher[name])
    assert not torch.equal(model.state_dict()["classify.weight"], untrained["classify.weight"])


@pytest.mark.slow
def test_runs_of_one_teacher_wait_for_it(material: Material, tmp_path: Path) -> None:
    rows = [Row(name, Run(name, schedule=SCHEDULE, masks=SCHEDULE)) for name in LINE_MODELS]
    outcomes = do_rows(rows, material.locations, tmp_path, 2)
    assert [set(outcome.figures) for outcome in outcomes] == [{"all", "night", "mapped ground"}] * 2
    assert sorted(folder.name.split("-")[0] for folder in tmp_path.iterdir()) == ["maptr", "raster", "stream"]


def test_an_epoch_begins_where_all_samples_were_seen() -> None:
    schedule = Schedule(batch_size=3)
    assert [epoch_of(schedule, 7, step) for step in range(-1, 6)] == [0, 0, 0, 0, 1, 1, 2]


def test_every_epoch_of_a_training_hides_something_else_of_the_prior(
    material: Material, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    epochs: list[int] = []
    monkeypatch.setattr(PriorDataset, "set_epoch", lambda self, epoch: epochs.append(epoch))
    trained_model(WITH_PRIOR, task_of("raster", material.locations), material, tmp_path, lambda _: None)
    assert epochs == [0, 0, 1]  # three steps of two samples, of four


def test_the_best_constant_mask_is_what_all_truths_share(material: Material) -> None:
    task = task_of("raster", material.locations)
    assert isinstance(task, MapTask)
    figures = constant_mask_figures(task, material)
    assert 20 < figures["all"]["mean"] < 100  # the drives pass the same crossroads, a little apart
    assert figures["night"] == figures["all"]  # the one test drive is at night
    assert "day" not in figures


def test_colours_are_a_prior_of_a_store_of_their_own(locations: Locations, material: Material, tmp_path: Path) -> None:
    publish(tmp_path / "colours", "build-2", None, drive_names={"drive-0": toy_dataset.TRAIN_SCENE})
    both = Material(replace(locations, colours_store=str(tmp_path / "colours")))
    assert both.prior_digest("colours") != both.prior_digest("presight")
    assert both.voxel_channels("colours") == 4 + both.colour_priors.channel_count
    run, task = Run("raster", "colours"), task_of("raster", locations)
    seen = both.test_prior(run, Probe(), task.prior_grid)
    assert seen is not None
    assert seen.priors is both.colour_priors
    with pytest.raises(InputError, match="no store has the features `colours`; build one with --set features"):
        material.prior_digest("colours")


def test_the_table_of_features_has_colours_where_there_are_such_priors() -> None:
    labels = [{row.label for row in rows_of("features", Scope(colours=colours))} for colours in (False, True)]
    assert labels[1] - labels[0] == {"raster, colour statistics"}


def test_ground_is_mapped_where_the_prior_has_something_under_the_vehicle(material: Material) -> None:
    here, there = material.test[0], replace(material.test[0], world_from_ego=planar_transform(500.0, 0.0, 0.0))
    assert (material.is_mapped(here), material.is_mapped(there)) == (True, False)
    assert material.groups_of(here.token) == ("all", "night", "mapped ground")


def test_a_run_is_kept_and_named_by_all_that_decides_it(material: Material, tmp_path: Path) -> None:
    runs = [WITH_PRIOR, Run("raster", "presight", seed=1, schedule=SCHEDULE), Run("raster", schedule=SCHEDULE)]
    assert len({run_folder(run, material, tmp_path) for run in runs}) == 3
    assert run_folder(Run("raster", "presight", schedule=Schedule(3, 2)), material, tmp_path) == run_folder(
        WITH_PRIOR, material, tmp_path
    )


def test_a_job_that_is_done_is_not_done_again(locations: Locations, tmp_path: Path) -> None:
    job = Job(WITH_PRIOR, (Probe(), Probe(drives="none")), locations, tmp_path)
    first = do_job(job)
    before = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.*")}
    assert do_job(job) == first
    assert {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.*")} == before
    assert {file.suffix for file in before} == {".safetensors", ".json"}  # no checkpoint, no word of progress is left


def test_runs_at_work_are_those_that_said_something_lately(tmp_path: Path) -> None:
    for name, ago_s in (("at-work", 1.0), ("killed", 3600.0)):
        file = tmp_path / name / "progress.json"
        file.parent.mkdir()
        file.write_text(json.dumps({"stage": name, "done": 1, "total": 2, "figures": {}}))
        os.utime(file, (time.time() - ago_s, time.time() - ago_s))
    assert [each.stage for each in running(tmp_path)] == ["at-work"]


def test_a_job_ends_when_nobody_waits_for_it(
    locations: Locations, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Dead:
        def is_alive(self) -> bool:
            return False

    def end(code: int) -> None:
        raise SystemExit(code)

    monkeypatch.setattr("multiprocessing.parent_process", Dead)
    monkeypatch.setattr("os._exit", end)
    with pytest.raises(SystemExit):
        do_job(Job(WITH_PRIOR, (Probe(),), locations, tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize(("model", "prior"), [("stream", "geometry"), ("maptr", "lidar"), ("bevdet-occ", "presight")])
def test_every_kind_of_model_is_trained_and_tried(model, prior, locations: Locations, tmp_path: Path) -> None:
    figures = do_job(Job(Run(model, prior, schedule=SCHEDULE), (Probe(),), locations, tmp_path))[0]
    assert 0 <= figures["all"]["mean"] <= 100
    assert figures["all"]["fps"] > 0
    assert ("static" in figures["all"]) == (model == "bevdet-occ")


@pytest.mark.slow
def test_rows_are_done_side_by_side_and_come_back_in_order(locations: Locations, tmp_path: Path) -> None:
    rows = [Row("b", Run("raster", schedule=SCHEDULE)), Row("a", None), Row("b", Run("raster", schedule=SCHEDULE))]
    outcomes = do_rows(rows, locations, tmp_path, parallel=2)
    assert [each.row.label for each in outcomes] == ["b", "a", "b"]
    assert outcomes[0].figures == outcomes[2].figures


def test_every_table_has_rows_of_every_seed_and_names_them_apart() -> None:
    for name in TABLES:
        rows = rows_of(name, Scope(seeds=2, schedule=SCHEDULE))
        seeds: dict[str, set[int]] = {}
        for row in rows:
            if row.run is not None:
                seeds.setdefault(row.label, set()).add(row.run.seed)
        assert all(found == {0, 1} for found in seeds.values()), name
        assert len({(row.run, row.probe) for row in rows}) == len(rows), name


def test_an_unknown_table_is_refused_with_the_known_ones() -> None:
    with pytest.raises(InputError, match="no experiment is named 'table-9'; choose one of: headline, maps"):
        rows_of("table-9", Scope())


def test_a_report_shows_means_and_spreads_over_seeds(tmp_path: Path) -> None:
    def outcome(seed: int, value: float) -> Outcome:
        figures = {"mean": value, "ped_crossing": value, "divider": value, "boundary": value}
        return Outcome(Row("raster", Run("raster", seed=seed)), {"all": figures, "night": figures})

    outcomes = [outcome(0, 10.0), outcome(1, 14.0)]
    columns, lines = table_of(outcomes)
    assert columns == ["", "mean", "ped_crossing", "divider", "boundary", "mean, night", "frames/s", "seeds"]
    assert lines == [["raster", *["12.0 ± 2.8"] * 5, "", "2"]]  # nobody timed these
    page = write_report("headline", outcomes, [], {"steps": 3}, tmp_path)
    assert "12.0 ± 2.8" in page.read_text()
    assert "| raster | 12.0 ± 2.8 |" in (tmp_path / "table.md").read_text()
    assert json.loads((tmp_path / "results.json").read_text())["rows"][1]["figures"]["all"]["mean"] == 14.0
