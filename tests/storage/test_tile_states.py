"""A tile's state follows its plan and its newest build, in either database."""

import pytest

from presight_core.progress import Progress
from storage.catalog import Catalog
from storage.tile_states import PlannedTile, TileState
from tests.storage.catalogs import RECIPE, Clock

NEW = PlannedTile("t000", "never built", RECIPE.digest, 2, 16)


@pytest.fixture
def catalog(url) -> Catalog:
    return Catalog.open(url, Clock())


def tile(catalog: Catalog) -> TileState:
    (found,) = catalog.tile_states.snapshot("toytown", "t000").tiles
    return found


def test_a_tile_goes_from_planned_to_published_and_stale(catalog):
    catalog.tile_states.save_plan("toytown", [NEW], catalog.now())
    states = [tile(catalog).state]
    build_id = catalog.start_build("toytown", "t000", RECIPE)
    states.append(tile(catalog).state)
    catalog.progress(build_id, Progress("training", 5, 10))
    states.append(tile(catalog).state)
    catalog.finish_build(build_id, "built", {"voxels": 7, "psnr_db": 21.5})
    states.append(tile(catalog).state)
    catalog.finish_build(build_id, "published", {"voxels": 7, "psnr_db": 21.5, "generation": 3})
    published = tile(catalog)
    states.append(published.state)
    catalog.tile_states.save_plan("toytown", [NEW._replace(reasons="drive a added", digest="x")], catalog.now())
    states.append(tile(catalog).state)
    assert states == ["planned", "queued", "running", "built", "published", "stale"]
    assert (published.voxels, published.psnr_db, published.generation, published.reasons) == (7, 21.5, 3, "")
    assert (published.drive_count, published.frame_count) == (2, 16)


def test_a_build_of_an_older_plan_leaves_the_tile_stale(catalog):
    build_id = catalog.start_build("toytown", "t000", RECIPE)
    catalog.tile_states.save_plan("toytown", [NEW._replace(reasons="drive a added", digest="x")], catalog.now())
    catalog.finish_build(build_id, "published", {})
    assert (tile(catalog).state, tile(catalog).reasons) == ("stale", "drive a added")


def test_a_failed_build_keeps_what_the_prior_shows_and_the_errors_first_line(catalog):
    catalog.finish_build(catalog.start_build("toytown", "t000", RECIPE), "published", {"generation": 1, "voxels": 9})
    catalog.finish_build(catalog.start_build("toytown", "t000", RECIPE), "failed", {}, "boom\nat line 1")
    assert (tile(catalog).state, tile(catalog).error, tile(catalog).voxels) == ("failed", "boom", 9)


def test_a_stage_remembers_when_and_where_it_began(catalog):
    build_id = catalog.start_build("toytown", "t000", RECIPE)
    for done in (40, 50):
        catalog.progress(build_id, Progress("training", done, 100))
    found = tile(catalog)
    assert (found.stage_done, found.done) == (40, 50)
    assert found.stage_at is not None
    assert found.started_at < found.stage_at < found.updated_at


def test_a_withdrawn_tile_shows_nothing(catalog):
    catalog.finish_build(catalog.start_build("toytown", "t000", RECIPE), "published", {"generation": 1, "voxels": 9})
    catalog.withdraw_tile("toytown", "t000")
    assert (tile(catalog).state, tile(catalog).voxels, tile(catalog).generation) == ("withdrawn", None, None)


def test_a_planned_tile_that_is_planned_no_more_is_forgotten(catalog):
    catalog.tile_states.save_plan("toytown", [NEW, NEW._replace(tile_id="t001")], catalog.now())
    catalog.tile_states.save_plan("toytown", [NEW], catalog.now())
    assert [each.tile_id for each in catalog.tile_states.snapshot("toytown").tiles] == ["t000"]


def test_totals_count_the_tiles_of_each_city_by_state(catalog):
    for city, voxels in (("toytown", 3), ("toytown", 4), ("othertown", 5)):
        build_id = catalog.start_build(city, f"t{voxels}", RECIPE)
        catalog.finish_build(build_id, "published", {"voxels": voxels, "generation": voxels})
    catalog.start_build("toytown", "t9", RECIPE)
    totals = [
        (total.city, total.state, total.tile_count, total.voxels) for total in catalog.tile_states.snapshot().totals
    ]
    assert catalog.tile_states.snapshot("othertown").totals == catalog.tile_states.snapshot().totals[:1]
    assert totals == [("othertown", "published", 1, 5), ("toytown", "published", 2, 7), ("toytown", "queued", 1, None)]


def test_a_catalog_of_before_gets_its_tile_states_from_its_builds(new_url):
    from alembic import command
    from alembic.config import Config

    import storage.migrations

    catalog = Catalog.open(new_url)
    catalog.finish_build(catalog.start_build("toytown", "t000", RECIPE), "published", {"voxels": 9, "generation": 2})
    catalog.finish_build(catalog.start_build("toytown", "t000", RECIPE), "failed", {}, "boom")
    config = Config()
    config.set_main_option("script_location", storage.migrations.__path__[0])
    with catalog._database.engine().begin() as connection:
        config.attributes["connection"] = connection
        command.downgrade(config, "0002")
    found = tile(Catalog.open(new_url))
    assert (found.state, found.error, found.voxels, found.generation) == ("failed", "boom", 9, 2)
