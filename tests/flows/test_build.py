"""A whole city through the Prefect flow: the smallest embedded city, two tiles, fields of a few steps."""

import json
from pathlib import Path

import numpy as np
import pytest

from flows.plan import plan_city
from flows.report import write_report
from presight_core.config import load_city_settings
from presight_core.priors.reader import PriorReader
from presight_core.synthetic import write_dataset
from storage.workspace import Workspace

pytestmark = pytest.mark.slow

CITY = "singapore-onenorth"
SETTINGS = """
preset = "demo"
[tiling]
tile_count = 2
sub_field_count = 2
[field.grid]
levels = 6
features_per_level = 4
max_resolution = 512
log2_rows = 12
[training]
steps = 40
batch_rays = 256
[extraction]
surface = "first-hit"
fog_density = 0.0
min_density = 0.0
max_depth_m = 900.0  # a field of so few steps is a fog with surfaces far away
below_camera_m = 500.0
above_camera_m = 500.0
pixel_stride = 8
[validation]
min_voxels = 1
min_psnr_db = 1.0
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("data")
    write_dataset(root, "ci", seed=0)
    return root


@pytest.fixture(scope="module")
def built(data, tmp_path_factory, presight) -> Workspace:
    """A workspace whose city was built once."""
    folder = tmp_path_factory.mktemp("workspace")
    (folder / "cities").mkdir()
    (folder / "cities" / f"{CITY}.toml").write_text(SETTINGS)
    for command in (("ingest", data, "--version", "v1.0-mini"), ("build", CITY)):
        result = presight(folder, *command)
        assert result.returncode == 0, result.stderr
    return Workspace.open(folder)


def plan_of(workspace: Workspace, *overrides: str):
    return plan_city(workspace, CITY, load_city_settings(workspace.city_file(CITY), overrides))


def test_one_generation_shows_every_tile(built):
    generation = built.store().generation(CITY)
    assert generation is not None
    assert generation.number == 1
    assert sorted(generation.tiles) == ["t000", "t001"]
    assert all(tile.entry.voxel_count > 0 for tile in generation.tiles.values())


def test_the_reader_sees_the_streets_that_were_driven_and_finds_every_voxel(built):
    world_from_ego = np.eye(4)
    world_from_ego[:3, 3] = built.drives().frames(built.catalog().drives(CITY)[0].drive_id).positions.mean(0)
    reader = PriorReader.open(built.store_location, CITY, generation=1)
    assert reader.window(world_from_ego, (-5, 5), (-5, 5)).coverage > 0.9
    everything = reader.window(world_from_ego, (-2000, 2000), (-2000, 2000), (-600, 600))
    assert len(everything) == sum(tile.entry.voxel_count for tile in reader.generation.tiles.values())


def test_the_generation_names_the_drives_it_was_made_from(built):
    drives = built.catalog().drives(CITY)
    assert PriorReader.open(built.store_location, CITY).drive_names == {each.drive_id: each.name for each in drives}


def test_tiles_share_no_voxel(built):
    reader = PriorReader.open(built.store_location, CITY)
    first, second = (set(map(tuple, reader.tile(tile_id).block_index.tolist())) for tile_id in reader.tiles)
    assert first and second
    assert not first & second


def test_building_again_builds_nothing(built, presight):
    answer = json.loads(presight(built.root, "build", CITY, "--json").stdout)
    assert (answer["generation"], answer["published"], answer["failed"]) == (1, [], {})


def test_a_changed_setting_makes_tiles_stale_and_is_named_as_the_reason(built):
    reasons = {reason for tile in plan_of(built, "training.steps=41").stale for reason in tile.reasons}
    assert reasons == {"setting training.steps: 40 -> 41"}


def test_how_often_checkpoints_are_written_changes_nothing(built):
    assert plan_of(built, "training.checkpoint_every=7").stale == ()


def test_a_report_has_a_page_and_its_pictures(built):
    page = write_report(built.root, CITY, None)
    text = page.read_text()
    pictures = sorted(file.name for file in page.parent.glob("*.png"))
    assert pictures == ["prior.png", "t000.png", "t001.png", "tiles.png"]
    assert all(f'src="{name}"' in text for name in pictures)


def test_a_failed_tile_keeps_its_old_state_and_does_not_sink_the_city(built, presight):
    """Comes last: it publishes generation 2."""
    (field,) = (built.caches / "scratch" / CITY / "t001").glob("*/field/field.safetensors")
    field.write_bytes(field.read_bytes()[:100])
    other_rays = "--set", "extraction.pixel_stride=7", "--accept", "t000"  # 40 steps differ too much by them
    result = presight(built.root, "build", CITY, *other_rays)
    assert result.returncode == 6
    assert "t000: failed" not in result.stdout, result.stdout
    assert "t001: failed" in result.stdout
    before, after = (built.store().generation(CITY, number) for number in (1, 2))
    assert before is not None
    assert after is not None
    assert after.tiles["t001"] == before.tiles["t001"]
    assert after.tiles["t000"] != before.tiles["t000"]
    states = {row.tile_id: (row.state, row.error) for row in built.catalog().builds(CITY)}
    assert states["t000"][0] == "published"
    assert states["t001"][0] == "failed"
    assert "field" in states["t001"][1]
