"""A tile that differs too much from the build that it would replace is not published, unless told so."""

from collections import Counter
from dataclasses import dataclass, replace

import pytest

from flows.status import exit_code, status_of
from presight_core.priors.example import ExampleTile
from tests.torture.toy_city import CITY, ToyCity

CHANGE = ("training.steps=77",)  # makes every tile stale


@dataclass(frozen=True)
class ChangedCity(ToyCity):
    """The city, whose first tile now comes out as another one."""

    def example(self, tile_id: str) -> ExampleTile:
        same = super().example(tile_id)
        return replace(same, seed=99) if tile_id == "t000" else same


@pytest.fixture
def changed(city: ToyCity) -> ChangedCity:
    return ChangedCity(**vars(city))


def tiles_of(city: ToyCity) -> dict:
    generation = city.workspace.store().generation(CITY)
    assert generation is not None
    return generation.tiles


def test_the_tile_keeps_its_old_build_and_the_others_are_published(changed):
    before = tiles_of(changed)
    assert changed.build(overrides=CHANGE) == 2
    after = tiles_of(changed)
    assert after["t000"] == before["t000"]
    assert after["t001"] != before["t001"]


def test_the_catalog_says_why_and_the_exit_code_tells(changed):
    changed.build(overrides=CHANGE)
    (city,) = status_of(changed.workspace.catalog(), CITY)["cities"]
    tile = city["tiles"][0]
    assert (tile["state"], tile["generation"]) == ("failed", 1)
    assert tile["error"].startswith("not published: keeps 4")
    assert "of the old voxels" in tile["error"]
    assert tile["error"].endswith("publish it with `--accept t000`")
    assert exit_code(Counter(city["states"])) == 6


def test_the_figures_of_the_comparison_are_kept_with_the_build(changed):
    changed.build(overrides=CHANGE)
    failed, published = changed.workspace.catalog().builds(CITY)
    assert failed.metrics["agreement_old_found"] < 0.5
    names = ("coverage", "old_found", "new_found", "feature_cosine")
    assert [published.metrics[f"agreement_{name}"] for name in names] == [1.0] * 4
    assert tiles_of(changed)["t001"].lineage["metrics"]["agreement_old_found"] == 1.0


@pytest.mark.parametrize("accept", ["t000", "t*"])
def test_an_accepted_tile_is_published_in_spite_of_it(changed, accept: str):
    before = tiles_of(changed)
    assert changed.build(overrides=CHANGE, accept=(accept,)) == 2
    assert tiles_of(changed)["t000"] != before["t000"]
    assert changed.workspace.catalog().builds(CITY)[0].state == "published"


def test_accepting_another_tile_changes_nothing(changed):
    before = tiles_of(changed)
    changed.build(overrides=CHANGE, accept=("t001",))
    assert tiles_of(changed)["t000"] == before["t000"]


def test_a_build_that_is_bad_by_itself_is_not_published_whatever_is_accepted(city):
    before = tiles_of(city)
    assert city.build(overrides=(*CHANGE, "validation.min_psnr_db=30"), accept=("t*",)) == 1
    assert tiles_of(city) == before
