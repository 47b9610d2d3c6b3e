"""The catalog keeps what it was told, from however many processes, in either database it runs on."""

import multiprocessing
import os
import sqlite3
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import datetime, timedelta, timezone

import pytest

from presight_core.drives import Drive, Reject
from presight_core.errors import ConflictError, InputError, MissingDependencyError, NotFoundError, StoreError
from presight_core.progress import Progress
from presight_core.tiles import Tile, Tiling
from storage.catalog import Catalog
from storage.migrations import HEAD
from tests.storage.catalogs import RECIPE, Clock

DRIVE = Drive("0123456789abcdef", "scene-0001", "toytown", "/data", "v1.0-mini", "2020-09-13", 8, 10**15, 2 * 10**15)
OTHER = replace(DRIVE, drive_id="fedcba9876543210", name="scene-0002", city="othertown", start_us=1)
REJECT = Reject("image-missing", "/data/a.jpg", "no such file", "extract it", "scene-0001")
TILING = Tiling("tiling-1", "toytown", (Tile("t000", (0.1, -1e6)), Tile("t001", (1 / 3, 2.0))))


@pytest.fixture
def catalog(url) -> Catalog:
    return Catalog.open(url, Clock())


def test_a_drive_is_recorded_once(catalog):
    assert catalog.add_drive(DRIVE, [REJECT])
    assert not catalog.add_drive(DRIVE, [REJECT])
    assert catalog.drives("toytown") == [DRIVE]
    assert catalog.rejects("toytown") == [REJECT]


def test_drives_and_rejects_are_told_apart_by_city(catalog):
    catalog.add_drive(DRIVE, [REJECT])
    catalog.add_drive(OTHER)
    assert catalog.cities() == ["othertown", "toytown"]
    assert catalog.drives("othertown") == [OTHER]
    assert catalog.rejects("othertown") == []
    assert (catalog.drives(), catalog.rejects()) == ([OTHER, DRIVE], [REJECT])


def test_a_new_catalog_is_empty(catalog):
    assert (catalog.cities(), catalog.drives(), catalog.builds("toytown"), catalog.tiling("toytown")) == (
        [],
        [],
        [],
        None,
    )


def test_a_drive_without_frames_is_refused(catalog):
    with pytest.raises(InputError, match="no good frame"):
        catalog.add_drive(replace(DRIVE, frame_count=0))
    assert catalog.drives() == []


def test_a_corrected_drive_takes_the_place_of_its_faulty_self(catalog):
    corrected = replace(DRIVE, drive_id="1111111111111111", frame_count=9)
    catalog.add_drive(DRIVE, [REJECT])
    assert catalog.add_drive(corrected)
    assert catalog.drives("toytown") == [corrected]
    assert catalog.rejects("toytown") == []


def test_a_drive_of_the_same_name_in_another_root_stands_beside(catalog):
    elsewhere = replace(DRIVE, drive_id="1111111111111111", root="/elsewhere")
    catalog.add_drive(DRIVE)
    catalog.add_drive(elsewhere)
    assert len(catalog.drives("toytown")) == 2


def test_a_drive_that_moved_is_found_at_its_new_root(catalog):
    catalog.add_drive(DRIVE)
    assert not catalog.add_drive(replace(DRIVE, root="/elsewhere"))
    assert catalog.drives("toytown") == [replace(DRIVE, root="/elsewhere")]


def test_a_removed_drive_comes_back_when_added_again(catalog):
    catalog.add_drive(DRIVE)
    catalog.remove_drive(DRIVE.drive_id)
    assert (catalog.drives(), catalog.cities()) == ([], [])
    assert catalog.add_drive(DRIVE)
    assert catalog.drives() == [DRIVE]


def test_removing_an_unknown_drive_is_an_error(catalog):
    with pytest.raises(NotFoundError, match="presight status"):
        catalog.remove_drive("ffffffffffffffff")


def test_a_later_stage_adds_its_rejects_once(catalog):
    catalog.add_drive(DRIVE, [REJECT])
    broken = replace(REJECT, code="image-broken")
    catalog.add_rejects(DRIVE.drive_id, [REJECT, broken])
    catalog.add_rejects(DRIVE.drive_id, [broken])
    assert catalog.rejects("toytown") == [REJECT, broken]


def test_rejects_of_an_unknown_drive_are_refused(catalog):
    with pytest.raises(ConflictError):
        catalog.add_rejects("ffffffffffffffff", [REJECT])


def test_a_tiling_comes_back_to_the_last_bit(catalog):
    catalog.save_tiling(TILING, {"seed": 0})
    assert catalog.tiling("toytown") == TILING
    assert catalog.tiling_settings("toytown") == {"seed": 0}


def test_tiles_may_be_appended_to_a_tiling(catalog):
    longer = replace(TILING, tiles=(*TILING.tiles, Tile("t002", (5.0, 5.0))))
    catalog.save_tiling(TILING, {"seed": 0})
    catalog.save_tiling(longer, {"seed": 0})
    catalog.save_tiling(longer, {"seed": 0})
    assert catalog.tiling("toytown") == longer


@pytest.mark.parametrize("tiles", [TILING.tiles[:1], (Tile("t000", (9.0, 9.0)), TILING.tiles[1]), TILING.tiles[::-1]])
def test_a_recorded_tile_never_moves_or_vanishes(catalog, tiles):
    catalog.save_tiling(TILING, {})
    with pytest.raises(ConflictError, match="append tiles only"):
        catalog.save_tiling(replace(TILING, tiles=tiles), {})
    assert catalog.tiling("toytown") == TILING


def test_the_newest_tiling_is_the_citys(catalog):
    catalog.save_tiling(TILING, {})
    newer = replace(TILING, tiling_id="tiling-2", tiles=TILING.tiles[:1])
    catalog.save_tiling(newer, {})
    assert catalog.tiling("toytown") == newer


def test_a_build_tells_its_story(catalog):
    build_id = catalog.start_build("toytown", "t000", RECIPE)
    catalog.progress(build_id, Progress("training", 5, 10, {"loss": 0.25}))
    (running,) = catalog.builds("toytown")
    assert (running.state, running.stage, running.done, running.total) == ("running", "training", 5, 10)
    assert (running.figures, running.finished_at, running.error) == ({"loss": 0.25}, None, "")
    catalog.finish_build(build_id, "built", {"psnr_db": 21.5})
    catalog.finish_build(build_id, "published")
    (done,) = catalog.builds("toytown")
    assert (done.build_id, done.state, done.metrics) == (build_id, "published", {"psnr_db": 21.5})
    assert (done.recipe, done.recipe_digest) == (RECIPE.to_json(), RECIPE.digest)


def test_times_are_utc_and_come_from_the_catalogs_clock(url):
    eastern = timezone(timedelta(hours=8))
    catalog = Catalog.open(url, lambda: datetime(2026, 11, 22, 14, 15, tzinfo=eastern))
    catalog.finish_build(catalog.start_build("toytown", "t000", RECIPE), "failed", {}, "out of memory")
    (build,) = catalog.builds("toytown")
    assert build.started_at == build.finished_at == "2026-11-22T06:15:00.000000Z"
    assert build.error == "out of memory"


def test_the_latest_build_of_each_tile_is_listed(catalog):
    for tile_id in ("t001", "t000", "t001"):
        last = catalog.start_build("toytown", tile_id, RECIPE)
    catalog.start_build("othertown", "t001", RECIPE)
    builds = catalog.builds("toytown")
    assert [build.tile_id for build in builds] == ["t000", "t001"]
    assert builds[1].build_id == last


def test_the_published_build_is_found_behind_a_failed_one(catalog):
    first = catalog.start_build("toytown", "t000", RECIPE)
    catalog.finish_build(first, "published", {})
    catalog.finish_build(catalog.start_build("toytown", "t000", RECIPE), "failed", {}, "boom")
    assert [build.build_id for build in catalog.builds("toytown", "published")] == [first]


def test_an_ended_build_makes_no_more_progress(catalog):
    build_id = catalog.start_build("toytown", "t000", RECIPE)
    catalog.finish_build(build_id, "failed", {}, "boom")
    catalog.progress(build_id, Progress("training", 5, 10))
    assert catalog.builds("toytown")[0].done == 0


def test_finishing_an_unknown_build_is_an_error(catalog):
    with pytest.raises(NotFoundError, match="start_build"):
        catalog.finish_build(77, "built", {})


def test_everything_is_there_after_opening_again(url):
    Catalog.open(url).add_drive(DRIVE)
    assert Catalog.open(url).drives() == [DRIVE]


def test_threads_share_a_catalog(catalog):
    def build(number: int) -> int:
        build_id = catalog.start_build("toytown", f"t{number % 4:03}", RECIPE)
        catalog.progress(build_id, Progress("training", number, 40))
        return build_id

    with ThreadPoolExecutor(8) as pool:
        build_ids = list(pool.map(build, range(40)))
    assert len(set(build_ids)) == 40
    assert len(catalog.builds("toytown")) == 4


def add_from_a_process(url: str, number: int) -> bool:
    catalog = Catalog.open(url)
    catalog.add_drive(replace(DRIVE, drive_id=f"{number:016}", name=f"scene-{number}"))
    return catalog.add_drive(OTHER)


@pytest.mark.slow
def test_processes_make_and_fill_a_catalog_together(new_url):
    with multiprocessing.get_context("spawn").Pool(4) as pool:
        added = pool.starmap(add_from_a_process, [(new_url, number) for number in range(8)])
    assert added.count(True) == 1
    assert len(Catalog.open(new_url).drives("toytown")) == 8


def test_an_open_catalog_survives_a_fork(catalog):
    catalog.add_drive(DRIVE)
    code_of_child = os.fork()
    if code_of_child == 0:
        os._exit(0 if catalog.add_drive(OTHER) else 1)
    assert os.waitpid(code_of_child, 0)[1] == 0
    assert len(catalog.drives()) == 2


def test_a_transaction_that_fails_leaves_nothing(catalog):
    with pytest.raises(TypeError):
        catalog.add_drive(DRIVE, [REJECT, "no reject"])
    assert catalog.drives() == []


def test_sqlite_keeps_what_it_acknowledged(tmp_path):
    catalog = Catalog.open(f"sqlite:///{tmp_path}/catalog.sqlite")
    with catalog._database.reading() as query:
        assert query("PRAGMA synchronous") == [{"synchronous": 2}]  # FULL
        assert query("PRAGMA journal_mode") == [{"journal_mode": "wal"}]
        assert query("PRAGMA foreign_keys") == [{"foreign_keys": 1}]


def test_the_head_revision_is_the_newest_migration():
    from alembic.config import Config
    from alembic.script import ScriptDirectory

    import storage.migrations

    config = Config()
    config.set_main_option("script_location", storage.migrations.__path__[0])
    assert ScriptDirectory.from_config(config).get_heads() == [HEAD]


def test_a_catalog_of_a_newer_version_is_refused(url):
    catalog = Catalog.open(url)
    with catalog._database.writing() as query:
        query("UPDATE alembic_version SET version_num = '9999'")
    with pytest.raises(StoreError, match="newer version"):
        Catalog.open(url)


def test_a_file_that_is_no_database_is_refused(tmp_path):
    file = tmp_path / "catalog.sqlite"
    file.write_text("not a database, but long enough to look at " * 10)
    with pytest.raises(StoreError, match="file is not a database"):
        Catalog.open(f"sqlite:///{file}")


def test_a_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match=r"File exists|Not a directory"):
        Catalog.open(f"sqlite:///{tmp_path}/file/catalog.sqlite")


@pytest.mark.parametrize("url", ["nonsense", "sqlite:///", "nosuchdatabase://host/name"])
def test_a_url_that_is_none_is_refused(url):
    with pytest.raises(StoreError, match=r"give a URL|name a file"):
        Catalog.open(url)


def test_an_absent_driver_is_named_with_its_cure(monkeypatch):
    monkeypatch.setitem(sys.modules, "psycopg", None)
    with pytest.raises(MissingDependencyError, match=r"pip install psycopg\[binary\]"):
        Catalog.open("postgresql+psycopg://user:secret@localhost/catalog")


def test_a_locked_database_is_an_error_of_the_store(tmp_path, monkeypatch):
    monkeypatch.setattr("storage.database.PRAGMAS", ("PRAGMA busy_timeout = 1",))
    catalog = Catalog.open(f"sqlite:///{tmp_path}/catalog.sqlite")
    blocker = sqlite3.connect(tmp_path / "catalog.sqlite", isolation_level=None)
    blocker.execute("BEGIN IMMEDIATE")
    with pytest.raises(StoreError, match="locked"):
        catalog.add_drive(DRIVE)
    blocker.close()


def test_reading_an_sqlite_catalog_imports_neither_sqlalchemy_nor_numpy(tmp_path):
    url = f"sqlite:///{tmp_path}/catalog.sqlite"
    Catalog.open(url).start_build("toytown", "t000", RECIPE)
    code = (
        f"import sys; from storage.catalog import Catalog; assert len(Catalog.open({url!r}).builds('toytown')) == 1;"
        "print(sorted({'sqlalchemy', 'alembic', 'numpy'} & sys.modules.keys()))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
