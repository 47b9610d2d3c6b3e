"""The catalog tells what the newest generation shows, also after a rollback and after a crash."""

import time
from dataclasses import asdict, replace

import pytest

from flows.drives import remove_drive
from flows.publication import roll_back
from flows.reconcile import rebuild, reconcile
from presight_core.errors import StoreError
from storage.catalog import Catalog
from tests.torture.toy_city import CITY, ToyCity

OTHER = ("training.steps=77",)


def tile(city: ToyCity, tile_id: str = "t000"):
    (found,) = city.workspace.catalog().tile_states.snapshot(CITY, tile_id).tiles
    return found


def shown_builds(city: ToyCity) -> list[dict]:
    builds = city.workspace.catalog().builds(CITY, "published")
    return [asdict(replace(build, build_id=0)) for build in builds]


def test_a_rollback_brings_the_earlier_builds_back_into_the_catalog(city):
    first, shown = shown_builds(city), tile(city)
    city.build(overrides=OTHER)
    assert shown_builds(city) != first
    assert roll_back(city.root, CITY, 1) == 3
    assert shown_builds(city) == first
    after = tile(city)
    assert (after.state, after.reasons, after.generation) == ("stale", "an earlier build is shown again", 3)
    assert (after.published_at, after.voxels, after.psnr_db) == (shown.published_at, shown.voxels, shown.psnr_db)
    assert city.build() == 3, "it is what the settings ask for"
    assert tile(city).state == "published"


def test_a_rollback_of_a_rollback_brings_the_later_builds_back(city):
    city.build(overrides=OTHER)
    later = shown_builds(city)
    roll_back(city.root, CITY, 1)
    roll_back(city.root, CITY, 2)
    assert shown_builds(city) == later
    assert tile(city).generation == 4


def test_a_rollback_brings_a_withdrawn_tile_back(city):
    store = city.workspace.store()
    before = shown_builds(city)
    store.publish(CITY, {"t001": None}, 1)
    roll_back(city.root, CITY, 2)  # which only looks, and finds that a tile is gone
    assert (tile(city, "t001").state, tile(city, "t001").voxels) == ("withdrawn", None)
    assert roll_back(city.root, CITY, 1) == 4
    assert shown_builds(city) == before
    assert tile(city, "t001").voxels == before[1]["metrics"]["voxels"]


def test_a_rebuilt_catalog_tells_what_a_rollback_shows(city):
    city.build(overrides=OTHER)
    roll_back(city.root, CITY, 1)
    before = shown_builds(city), tile(city).generation, tile(city).published_at
    for file in city.root.glob("catalog.sqlite*"):
        file.unlink()
    rebuild(city.root, as_json=True)
    assert (shown_builds(city), tile(city).generation, tile(city).published_at) == before


def test_a_crash_after_a_withdrawal_is_made_good_by_the_next_run(city, monkeypatch):
    (city.root / "presight.toml").write_text("lease_s = 1.0\n")
    for name in ("scene-0000", "scene-0001"):
        remove_drive(city.workspace, name)

    def die(*_) -> None:
        raise StoreError("the catalog is gone")

    with monkeypatch.context() as patch:
        patch.setattr(Catalog, "withdraw_tile", die)
        with pytest.raises(StoreError):
            city.build()
    head = city.workspace.store().generation(CITY)
    assert head is not None
    assert (head.tiles, len(shown_builds(city))) == ({}, 2), "the catalog is behind"
    time.sleep(1.1)  # until the lease, which is not given back after an error of the store, is over
    reconcile(city.workspace)
    assert shown_builds(city) == []
    assert {tile(city, tile_id).state for tile_id in ("t000", "t001")} == {"withdrawn"}
