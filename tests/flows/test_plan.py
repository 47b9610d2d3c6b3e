"""A plan names every reason for a stale tile, what the build will cost and what it leaves alone."""

import json
from dataclasses import replace

import pytest

from flows.drives import remove_drive
from flows.forecast import cost_line, forecast, plan_json, untouched_line
from flows.ingest import ingest_root
from flows.plan import CityPlan, plan_city
from flows.staleness import stale_reasons
from presight_core.config import load_city_settings
from stages import versions
from tests.tiny_dataset import TinyDataset
from tests.torture.toy_city import CITY, VERSION, ToyCity

APART = "tiling.overlap_m=0"  # each of the two drives lies in a tile of its own


def plan_of(city: ToyCity, *overrides: str) -> CityPlan:
    return plan_city(city.workspace, CITY, load_city_settings(city.workspace.city_file(CITY), overrides))


def reasons(plan: CityPlan) -> set[tuple[str, str]]:
    return {(cause.kind, cause.text) for tile in plan.tiles for cause in tile.causes}


def ingest_moved(city: ToyCity, metres: float) -> None:
    """Ingest the city's data again, its first drive moved to the north; the data are put back afterwards."""
    moved = TinyDataset(city.data, VERSION)
    for row in moved.tables["ego_pose"][: len(moved.tables["ego_pose"]) // 2]:
        row["translation"][1] += metres
    ingest_root(city.root, moved.write(), VERSION, keep_going=False, as_json=False)
    TinyDataset(city.data, VERSION).write()


def test_a_current_city_has_no_reasons(city):
    assert (reasons(plan_of(city)), plan_of(city).is_current) == (set(), True)


def test_a_changed_setting_is_named_with_both_values(city):
    assert reasons(plan_of(city, "training.steps=77")) == {("setting", "setting training.steps: 1200 -> 77")}
    assert reasons(plan_of(city, "extraction.min_hits=3")) == {("setting", "setting extraction.min_hits: 1 -> 3")}


@pytest.mark.parametrize("stage", ["features", "training", "extraction"])
def test_a_raised_code_version_is_named_with_its_stage(city, monkeypatch, stage):
    number = getattr(versions, stage.upper())
    monkeypatch.setattr(versions, stage.upper(), number + 1)
    assert reasons(plan_of(city)) == {("code version", f"code version of {stage}: {number} -> {number + 1}")}


def test_a_changed_model_is_named(city):
    tile = plan_of(city).tiles[0]
    assert tile.recipe is not None
    published = json.loads(json.dumps(tile.recipe.to_json()))
    published["inputs"]["training"]["inputs"]["features"]["inputs"]["feature_model"]["sha256"] = "old"
    (reason,) = stale_reasons(published, tile.recipe.to_json(), plan_of(city).known, city.workspace.drives())
    assert (reason.kind, reason.text[:43]) == ("model", "model changed: feature_model.sha256: old ->")


def test_a_removed_drive_and_one_that_came_back_are_named(city):
    remove_drive(city.workspace, "scene-0001")
    assert reasons(plan_of(city)) == {("drive removed", "drive scene-0001 was removed")}
    city.build()
    city.ingest()
    assert reasons(plan_of(city)) == {("drive added", "drive scene-0001 added")}


def test_a_re_posed_drive_is_named_with_how_far_it_moved(city):
    ingest_moved(city, 0.5)
    assert reasons(plan_of(city)) == {("drive changed", "drive scene-0000 re-posed, by up to 0.50 m")}


def test_only_the_tiles_that_a_drive_touches_are_stale(city):
    city.build(overrides=(APART,))
    remove_drive(city.workspace, "scene-0001")
    plan = plan_of(city, APART)
    assert reasons(plan) == set()
    assert plan.withdrawn == {"t001": "drive scene-0001 was removed"}
    assert untouched_line(plan).startswith("untouched: t000 (")


def test_the_cost_comes_from_past_builds_and_goes_with_the_rays(city):
    plan = plan_of(city, "training.steps=2400")
    first, second = plan.tiles
    assert first.past is not None
    timed = replace(first, past=replace(first.past, metrics={"seconds": 100.0}))
    cost = forecast(city.workspace, replace(plan, tiles=(timed, second)))
    assert cost.tile_seconds == pytest.approx({"t000": 200.0, "t001": 200.0})
    assert (cost.seconds, cost.like_others, cost.rays) == (pytest.approx(400.0), ("t001",), 2 * 2400 * 1024)
    assert cost.bytes == first.bytes + second.bytes
    assert cost.drives_without_features == ("scene-0000", "scene-0001")
    assert "about 400 s of tile time, 1 of them taken to be as the others" in cost_line(plan, cost)
    assert json.loads(json.dumps(plan_json(plan, cost)))["tiles"][0]["kinds"] == ["setting"]


def test_without_a_past_build_the_time_is_unknown(city):
    plan = plan_of(city, "training.steps=2400")
    assert "time unknown" in cost_line(plan, forecast(city.workspace, plan))


def test_a_drive_on_new_ground_founds_a_tile_and_moves_none(city):
    before = plan_of(city).tiling.tiles
    remote = TinyDataset(city.root / "remote", VERSION)
    for row in remote.tables["ego_pose"]:
        row["translation"][0] += 20_000
    ingest_root(city.root, remote.write(), VERSION, keep_going=False, as_json=False)
    plan = plan_of(city)
    assert plan.tiling.tiles[:2] == before
    assert [(tile.tile_id, tile.reasons) for tile in plan.stale] == [("t002", ("never built",))]
    assert city.build() == 2
    assert plan_of(city).is_current
