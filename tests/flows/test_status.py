"""The status says what the catalog says: in words for people, in a fixed schema and exit codes for programs."""

import json
from collections import Counter

import pytest

from flows.drives import remove_drive
from flows.plan import plan_city, record_plan
from flows.status import SCHEMA, Request, current_status, exit_code, show_status, status_of
from presight_core.config import load_city_settings
from presight_core.drives import Drive
from presight_core.errors import InputError, NotFoundError
from presight_core.progress import Progress
from storage.catalog import Catalog
from tests.storage.catalogs import RECIPE, Clock
from tests.torture.toy_city import CITY

DRIVE = Drive("0123456789abcdef", "scene-0001", "toytown", "/data", "v1.0-mini", "2020-09-13", 8, 1, 2)
CITY_NAMES = "city drives generation plan_is_outdated planned_at states tiles updated_at voxels"
TILE_NAMES = (
    "age_s done drive_count error eta_s frame_count generation percent psnr_db published_at reasons stage started_at "
    "state tile_id total updated_at voxels"
)


@pytest.fixture
def catalog(tmp_path) -> Catalog:
    return Catalog.open(f"sqlite:///{tmp_path}/catalog.sqlite", Clock())


def test_the_schema_has_the_documented_names(catalog):
    catalog.start_build("toytown", "t000", RECIPE)
    report = status_of(catalog, "toytown")
    assert (report["schema"], sorted(report)) == (SCHEMA, ["at", "cities", "schema"])
    assert " ".join(sorted(report["cities"][0])) == CITY_NAMES
    assert " ".join(sorted(report["cities"][0]["tiles"][0])) == TILE_NAMES


def test_the_time_left_goes_with_the_pace_since_the_stage_began(catalog):
    """The clock moves a second at every look: one between the two reports, one before the status."""
    build_id = catalog.start_build("toytown", "t000", RECIPE)
    catalog.progress(build_id, Progress("training", 900, 1000))  # a resumed training
    catalog.progress(build_id, Progress("training", 920, 1000))
    (tile,) = status_of(catalog, "toytown")["cities"][0]["tiles"]
    assert (tile["percent"], tile["eta_s"]) == (92.0, 3.0)  # 80 of 20 a second, less the second since


def test_the_time_left_is_unknown_while_nothing_moved(catalog):
    build_id = catalog.start_build("toytown", "t000", RECIPE)
    catalog.progress(build_id, Progress("training", 0, 1000))
    assert status_of(catalog, "toytown")["cities"][0]["tiles"][0]["eta_s"] is None


def test_one_tile_comes_with_all_its_metrics(catalog):
    metrics = {"voxels": 5, "generation": 1, "loss": 0.5}
    catalog.finish_build(catalog.start_build("toytown", "t000", RECIPE), "published", metrics)
    catalog.start_build("toytown", "t001", RECIPE)
    (tile,) = status_of(catalog, "toytown", "t000")["cities"][0]["tiles"]
    assert (tile["tile_id"], tile["metrics"], tile["age_s"]) == ("t000", metrics, pytest.approx(2.0))


def test_the_metrics_are_of_the_build_that_is_shown(catalog):
    catalog.finish_build(catalog.start_build("toytown", "t000", RECIPE), "published", {"loss": 0.5})
    catalog.finish_build(catalog.start_build("toytown", "t000", RECIPE), "failed", {"loss": 9.0}, "boom")
    (tile,) = status_of(catalog, "toytown", "t000")["cities"][0]["tiles"]
    assert (tile["state"], tile["metrics"]) == ("failed", {"loss": 0.5})


def test_work_that_belongs_to_no_tile_is_shown_while_it_runs(catalog):
    build_id = catalog.start_build("toytown", "all tiles", RECIPE)
    assert len(status_of(catalog, "toytown")["cities"][0]["tiles"]) == 1
    catalog.finish_build(build_id, "built", {})
    catalog.add_drive(DRIVE)
    (city,) = status_of(catalog, "toytown")["cities"]
    assert (city["tiles"], city["states"]) == ([], {})


def test_of_many_tiles_those_that_need_attention_come_first(catalog):
    for number in range(4):
        build_id = catalog.start_build("toytown", f"t{number}", RECIPE)
        catalog.finish_build(build_id, "failed" if number == 2 else "published", {})
    (city,) = status_of(catalog, "toytown", most=2)["cities"]
    assert [tile["tile_id"] for tile in city["tiles"]] == ["t2", "t0"]
    assert city["states"] == {"failed": 1, "published": 3}


def test_a_city_or_tile_that_is_none_is_refused(catalog):
    catalog.start_build("toytown", "t000", RECIPE)
    with pytest.raises(NotFoundError, match="no such city here"):
        status_of(catalog, "atlantis")
    with pytest.raises(NotFoundError, match="no tile t9"):
        status_of(catalog, "toytown", "t9")
    with pytest.raises(InputError, match="presight status CITY --tile t000"):
        status_of(catalog, None, "t000")


def test_a_catalog_that_is_still_empty_is_made(tmp_path):
    assert current_status(f"sqlite:///{tmp_path}/catalog.sqlite")["cities"] == []


@pytest.mark.parametrize(
    ("states", "code"),
    [
        ({"published": 3}, 0),
        ({}, 0),
        ({"published": 3, "stale": 1}, 8),
        ({"planned": 1}, 8),
        ({"stale": 1, "running": 1}, 7),
        ({"running": 1, "failed": 1}, 6),
    ],
)
def test_exit_codes_tell_scripts_what_matters_most(states, code):
    assert exit_code(Counter(states)) == code


def test_a_city_is_followed_from_its_plan_to_a_removed_drive(city, capsys):
    workspace = city.workspace

    def say(**wanted) -> tuple[int, str]:
        code = show_status(city.root, Request(CITY, exit_code=True, **wanted))
        return code, capsys.readouterr().out

    assert say()[0] == 0
    plan = plan_city(workspace, CITY, load_city_settings(workspace.city_file(CITY), ["training.steps=77"]))
    record_plan(workspace, plan)
    code, text = say()
    assert (code, text.count("setting training.steps: 1200 -> 77")) == (8, 2)
    city.build(overrides=("training.steps=77",))
    assert say()[0] == 0
    remove_drive(workspace, "scene-0001")
    code, text = say(as_json=True)
    (shown,) = json.loads(text)["cities"]
    assert (code, shown["states"], shown["plan_is_outdated"]) == (8, {"stale": 2}, True)
    assert {tile["reasons"] for tile in shown["tiles"]} == {"drive scene-0001 was removed"}


def test_the_exit_code_of_a_tile_heeds_no_other_tile(city, capsys):
    catalog = city.workspace.catalog()
    catalog.finish_build(catalog.start_build(CITY, "t000", RECIPE), "failed", {}, "boom")
    catalog.finish_build(catalog.start_build(CITY, "t001", RECIPE), "published", {})
    codes = [show_status(city.root, Request(CITY, tile, exit_code=True)) for tile in ("t000", "t001", None)]
    assert codes == [6, 0, 6]
    assert capsys.readouterr().out


def test_watching_ends_when_nothing_runs(city, capsys, monkeypatch):
    catalog = city.workspace.catalog()
    build_id = catalog.start_build(CITY, "t000", RECIPE)
    monkeypatch.setattr("flows.status.time.sleep", lambda _: catalog.finish_build(build_id, "failed", {}, "boom"))
    assert show_status(city.root, Request(CITY, watch=True, exit_code=True)) == 6
    assert capsys.readouterr().out.count(f"{CITY}:") == 2
