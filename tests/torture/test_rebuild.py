"""A catalog that is lost is made again from the store and the drive index, with the same rows."""

from dataclasses import asdict, replace

import pytest

from flows.reconcile import rebuild
from presight_core.errors import ConflictError
from storage.catalog import Catalog
from tests.torture import children
from tests.torture.conftest import whole_run
from tests.torture.toy_city import CITY, ToyCity

pytestmark = pytest.mark.slow


def rows(catalog: Catalog) -> dict:
    """All that a catalog says of the city, but for the numbers that it gives to builds."""
    with catalog._database.reading() as query:
        drives = query("SELECT * FROM drives ORDER BY drive_id")
    builds = [asdict(replace(build, build_id=0)) for build in catalog.builds(CITY, "published")]
    tiling = catalog.tiling(CITY)
    assert tiling is not None
    return {
        "drives": drives,
        "rejects": [asdict(reject) for reject in catalog.rejects()],
        "tiling": [tiling.to_json(), catalog.tiling_settings(CITY), catalog.tiling_created_at(CITY)],
        "builds": builds,
    }


def lose_catalog(city: ToyCity) -> None:
    for file in city.root.glob("catalog.sqlite*"):
        file.unlink()


def test_the_rebuilt_catalog_has_the_same_rows(city):
    def work(acknowledge) -> None:
        city.ingest()
        city.build()
        city.build(overrides=("training.steps=77",))
        drive = city.workspace.catalog().drives(CITY)[0]
        at = city.workspace.catalog().now()
        city.workspace.catalog().remove_drive(drive.drive_id, at)
        city.workspace.drives().mark_removed(drive.drive_id, at)
        acknowledge(rows(city.workspace.catalog()))
        lose_catalog(city)
        rebuild(city.root, as_json=True)
        acknowledge(rows(city.workspace.catalog()))

    code, (before, after) = children.run(work, city.root / "log")
    assert code == 0, (city.root / "log").read_text()
    assert len(before["builds"]) == len(before["drives"]) == 2
    assert all(row["metrics"]["generation"] == 2 for row in before["builds"])
    assert after == before


def test_after_a_rebuild_nothing_is_stale_and_the_next_run_may_publish(city, truth):
    def work(acknowledge) -> None:
        city.ingest()
        city.build()
        lose_catalog(city)
        rebuild(city.root, as_json=False)
        assert city.build() == 1
        acknowledge(city.build(overrides=("training.steps=77",)))

    assert children.run(work, city.root / "log") == (0, [2]), (city.root / "log").read_text()
    assert children.result(whole_run(city), city.root / "log") == truth


def test_a_catalog_in_use_is_not_overwritten(city):
    def work(acknowledge) -> None:
        city.ingest()
        with pytest.raises(ConflictError, match="move it away"):
            rebuild(city.root, as_json=False)
        acknowledge(True)

    assert children.run(work, city.root / "log") == (0, [True])
