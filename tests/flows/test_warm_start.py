"""What an update begins a tile with: the field that the tile has where only drives came, else nothing."""

import json
from dataclasses import replace

import numpy as np
import pytest

from flows.city import Order, tile_jobs
from flows.drives import remove_drive
from flows.forecast import cost_line, forecast, plan_json
from flows.ingest import ingest_root
from flows.plan import CityPlan, plan_city
from flows.reconcile import hold_city
from flows.warm_start import outside_share
from presight_core.config import load_city_settings
from presight_core.field.files import FIELD_FILE, SHAPE_FILE
from presight_core.recipes import aim_of, digest_of
from presight_core.tiles import SubField
from stages import versions
from tests.tiny_dataset import TinyDataset
from tests.torture.toy_city import CITY, VERSION, ToyCity

EVERYWHERE = SubField((0.0, 0.0, 0.0), (-1e4, -1e4, -1e4), (1e4, 1e4, 1e4))


def plan_of(city: ToyCity, *overrides: str) -> CityPlan:
    return plan_city(city.workspace, CITY, load_city_settings(city.workspace.city_file(CITY), overrides))


def why_cold(plan: CityPlan) -> str:
    """Why the first tile begins with nothing."""
    start = plan.tiles[0].start
    assert start is not None
    assert (start.training == plan.tiles[0].training) == bool(start.why_cold)
    return start.why_cold


def give_fields(city: ToyCity, box: SubField = EVERYWHERE) -> None:
    """Put a field where the training of each shown tile leaves it; only its outline is real."""
    generation = city.workspace.store().generation(CITY)
    assert generation is not None
    for tile_id, tile in generation.tiles.items():
        training = tile.recipe["inputs"]["training"]
        folder = city.workspace.scratch(CITY, tile_id, digest_of(training)) / "field"
        folder.mkdir(parents=True)
        (folder / FIELD_FILE).touch()
        (folder / SHAPE_FILE).write_text(json.dumps({"shape": {"sub_fields": [box.to_json()]}}))


@pytest.fixture
def grown(city: ToyCity) -> ToyCity:
    """A city that was built from one drive, with its fields, and got a second one."""
    remove_drive(city.workspace, "scene-0001")
    city.build()
    give_fields(city)
    city.ingest()
    return city


def test_a_tile_that_only_got_a_drive_goes_on_from_its_field(grown):
    (tile, _), generation = plan_of(grown).tiles, grown.workspace.store().generation(CITY)
    assert tile.start is not None
    assert tile.start.is_warm
    before = generation.tiles["t000"].recipe["inputs"]["training"]
    begun = tile.start.training.inputs["warm_start"]
    assert begun == {"training": digest_of(before), "drives": before["inputs"]["drives"], "steps": tile.start.steps}
    assert aim_of(tile.start.training.to_json()) == tile.training.to_json()
    assert tile.start.training.digest != tile.training.digest


def test_the_share_of_steps_is_a_setting_and_none_means_from_nothing(grown):
    plan = plan_of(grown, "update.warm_steps_share=0.25", "training.steps=1200")
    assert plan.tiles[0].start.steps == 300
    assert why_cold(plan_of(grown, "update.warm_steps_share=0")) == "update.warm_steps_share is 0"


def test_a_removed_drive_forbids_it_for_the_field_has_seen_it(city):
    give_fields(city)
    remove_drive(city.workspace, "scene-0001")
    assert why_cold(plan_of(city)) == "its field has seen what it may not: drive scene-0001 was removed"


def test_any_changed_setting_forbids_it(grown):
    assert why_cold(plan_of(grown, "training.seed=7")) == "setting training.seed: 0 -> 7"


def test_a_raised_version_of_training_forbids_it(grown, monkeypatch):
    monkeypatch.setattr(versions, "TRAINING", versions.TRAINING + 1)
    assert why_cold(plan_of(grown)).startswith("code version of training")


def test_a_field_that_was_cleared_forbids_it(grown):
    for file in grown.workspace.caches.rglob(FIELD_FILE):
        file.unlink()
    assert why_cold(plan_of(grown)) == "its field is not in the caches"


def test_cameras_outside_the_fields_boxes_forbid_it(city):
    remove_drive(city.workspace, "scene-0001")
    city.build()
    give_fields(city, replace(EVERYWHERE, box_max_m=(100.0, 1e4, 1e4)))  # the second drive begins at x = 200 m
    city.ingest()
    assert why_cold(plan_of(city)).startswith("50% of the cameras are outside the boxes of its field")


def test_where_only_the_extraction_changed_the_field_is_used_as_it_is(city):
    give_fields(city)
    (tile, _) = plan_of(city, "extraction.min_hits=3").tiles
    assert tile.start is not None
    assert (tile.start.is_warm, tile.start.steps, tile.start.training) == (True, 0, tile.training)


def test_a_warm_started_tile_is_current_afterwards(grown):
    assert grown.build(warm=True) == 3
    assert plan_of(grown).is_current
    tiles = grown.workspace.store().generation(CITY).tiles
    assert all("warm_start" in tile.recipe["inputs"]["training"]["inputs"] for tile in tiles.values())
    states = grown.workspace.catalog().tile_states.snapshot(CITY).tiles
    assert {(tile.state, tile.reasons) for tile in states} == {("published", "")}


def test_new_ground_founds_a_tile_that_begins_with_nothing_and_no_tile_moves(city):
    give_fields(city)
    before = plan_of(city).tiling.tiles
    remote = TinyDataset(city.root / "remote", VERSION)
    for row in remote.tables["ego_pose"]:
        row["translation"][0] += 20_000
    ingest_root(city.root, remote.write(), VERSION, keep_going=False, as_json=False)
    (stale,) = plan_of(city).stale
    assert stale.start is not None
    assert (stale.tile_id, stale.start.why_cold) == ("t002", "never built")
    old = city.workspace.store().generation(CITY)
    assert city.build(warm=True) == 2
    new = city.workspace.store().generation(CITY)
    assert plan_of(city).tiling.tiles[:2] == before
    assert {tile_id: new.tiles[tile_id] for tile_id in old.tiles} == old.tiles


def test_a_build_begins_with_nothing(grown):
    assert grown.build() == 3
    tiles = grown.workspace.store().generation(CITY).tiles
    assert all("warm_start" not in tile.recipe["inputs"]["training"]["inputs"] for tile in tiles.values())


def test_jobs_of_the_two_ways_train_in_different_folders(grown):
    workspace, plan = grown.workspace, plan_of(grown)
    with hold_city(workspace, CITY) as lease:
        warm, cold = (tile_jobs(workspace, plan, Order("", CITY, warm=warm), lease)["t000"] for warm in (True, False))
    assert warm.recipe != cold.recipe
    assert digest_of(warm.training_recipe) != digest_of(cold.training_recipe)


def test_a_plan_says_what_an_update_would_cost(grown):
    plan = plan_of(grown, "update.warm_steps_share=0.25")
    cost = forecast(grown.workspace, plan)
    assert cost.update_rays == cost.rays // 4
    line = cost_line(plan, cost).splitlines()[1]
    assert "2 of 2 tiles go on from the fields that they have; next: presight update toytown" in line
    assert plan_json(plan, cost)["tiles"][0]["warm_steps"] == 300


def test_a_forecast_knows_extraction_does_not_get_shorter_with_the_steps(grown):
    plan = plan_of(grown, "update.warm_steps_share=0.25")
    past = [replace(tile.past, metrics={"seconds": 110.0, "extraction_seconds": 10.0}) for tile in plan.tiles]
    tiles = tuple(replace(tile, past=each) for tile, each in zip(plan.tiles, past, strict=True))
    cost = forecast(grown.workspace, replace(plan, tiles=tiles))
    assert cost.tile_seconds == pytest.approx({"t000": 110.0, "t001": 110.0})
    assert cost.update_tile_seconds == pytest.approx({"t000": 35.0, "t001": 35.0})


def test_outside_is_a_camera_that_no_box_holds():
    boxes = [SubField((0, 0, 0), (-1, -1, -1), (1, 1, 1)), SubField((5, 0, 0), (4, -1, -1), (6, 1, 1))]
    cameras = np.array([[0.0, 0, 0], [5, 0, 0], [2.5, 0, 0], [0, 0, 9]])
    assert outside_share(cameras, boxes) == 0.5
