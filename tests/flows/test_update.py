"""A mapped city of four tiles gets a drive: only the tiles that it touches are built anew, from what they have."""

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from presight_core.priors.documents import Generation
from presight_core.priors.reader import PriorReader
from presight_core.synthetic import load_preset, write_dataset
from storage.workspace import Workspace

pytestmark = pytest.mark.slow

CITY = "singapore-onenorth"
STREETS = ["streets=4", 'train=["day", "day", "day", "day", "overcast"]', "style.size_m=340"]
SETTINGS = """
preset = "demo"
[tiling]
tile_count = 4
overlap_m = 5.0
[field.grid]
levels = 6
features_per_level = 4
max_resolution = 512
log2_rows = 12
[training]
steps = 20
batch_rays = 128
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
min_coverage = 0.0
min_geometry = 0.0
min_feature_cosine = -1.0
max_psnr_loss_db = 99.0
[update]
max_outside = 1.0  # the few streets of this city are short
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """Four drives on a street each, and a fifth on the street of the first."""
    root = tmp_path_factory.mktemp("data")
    write_dataset(root, load_preset("ci", ["keyframes=4", *(f"towns.{CITY}.{each}" for each in STREETS)]), seed=0)
    return root


@pytest.fixture(scope="module")
def mapped(data, tmp_path_factory, presight) -> Workspace:
    """A workspace whose city was built from the four drives."""
    folder = tmp_path_factory.mktemp("workspace")
    (folder / "cities").mkdir()
    (folder / "cities" / f"{CITY}.toml").write_text(SETTINGS)
    run(presight, folder, "ingest", data, "--version", "v1.0-mini", "--scene", "scene-000[1-4]")
    run(presight, folder, "build", CITY)
    return Workspace.open(folder)


def run(presight, folder: Path, *arguments: str | Path, code: int = 0) -> str:
    result = presight(folder, *arguments)
    assert result.returncode == code, result.stderr
    return result.stdout


def generation(workspace: Workspace, number: int | None = None) -> Generation:
    found = workspace.store().generation(CITY, number)
    assert found is not None
    return found


def build_counts(workspace: Workspace) -> dict[str, int]:
    """The newest build of every tile."""
    return {build.tile_id: build.build_id for build in workspace.catalog().builds(CITY)}


@pytest.fixture(scope="module")
def updated(data, mapped, presight) -> tuple[Workspace, dict]:
    """The city after the fifth drive came, and what the plan said before."""
    run(presight, mapped.root, "ingest", data, "--version", "v1.0-mini")
    plan = json.loads(run(presight, mapped.root, "plan", CITY, "--json"))
    run(presight, mapped.root, "update", CITY)
    return mapped, plan


def test_a_build_publishes_every_tile(mapped):
    assert sorted(generation(mapped).tiles) == ["t000", "t001", "t002", "t003"]


def test_only_the_tiles_that_the_drive_touches_are_built_and_the_others_stay_to_the_last_bit(updated):
    workspace, plan = updated
    before, after = generation(workspace, 1), generation(workspace, 2)
    touched = {tile["tile_id"] for tile in plan["tiles"] if tile["stale"]}
    assert 0 < len(touched) < 4
    assert {tile_id for tile_id in after.tiles if after.tiles[tile_id] != before.tiles[tile_id]} == touched
    assert after.tiling == before.tiling
    assert set(plan["untouched"]) == set(before.tiles) - touched


def test_the_tiles_went_on_from_their_fields_and_say_so(updated):
    workspace, plan = updated
    for tile in (tile for tile in plan["tiles"] if tile["stale"]):
        assert tile["warm_steps"] == 8  # of 20
        begun = generation(workspace, 2).tiles[tile["tile_id"]].recipe["inputs"]["training"]["inputs"]["warm_start"]
        assert begun["steps"] == 8
        folder = workspace.scratch(CITY, tile["tile_id"], begun["training"])
        assert (folder / "field" / "field.safetensors").exists()


def test_the_new_drive_is_in_the_prior(updated):
    workspace, _ = updated
    drive = next(drive for drive in workspace.catalog().drives(CITY) if drive.name == "scene-0005")
    assert drive.drive_id in PriorReader.open(workspace.store_location, CITY).drive_names
    world_from_ego = np.eye(4)
    world_from_ego[:3, 3] = workspace.drives().frames(drive.drive_id).positions.mean(0)
    views = {"x_m": (-2000, 2000), "y_m": (-2000, 2000), "z_m": (-600, 600)}
    reader = PriorReader.open(workspace.store_location, CITY)
    others = [each.drive_id for each in workspace.catalog().drives(CITY) if each != drive]
    assert len(reader.window(world_from_ego, **views, without_drives=others)) > 0


def test_the_city_is_current_afterwards(updated, presight):
    workspace, _ = updated
    answer = json.loads(run(presight, workspace.root, "update", CITY, "--json"))
    assert (answer["generation"], answer["published"]) == (2, [])
    assert run(presight, workspace.root, "status", CITY, "--exit-code")


def test_two_updates_at_once_build_nothing_twice(updated, presight):
    """The drive is removed, so that its tiles begin with nothing; the second update waits and finds nothing to do."""
    workspace, plan = updated
    before = generation(workspace, 1)
    run(presight, workspace.root, "drives", "remove", "scene-0005")
    builds = build_counts(workspace)
    with ThreadPoolExecutor(2) as pool:
        for output in pool.map(lambda _: run(presight, workspace.root, "update", CITY, "--wait"), range(2)):
            assert "generation 3" in output
    after, touched = generation(workspace), {tile["tile_id"] for tile in plan["tiles"] if tile["stale"]}
    assert after.number == 3
    # The removed drive is gone, and training is deterministic: the city is what it was before the drive came.
    assert {name: tile.entry.digest for name, tile in after.tiles.items()} == {
        name: tile.entry.digest for name, tile in before.tiles.items()
    }
    counts = build_counts(workspace)
    assert {name for name in before.tiles if counts[name] != builds[name]} == touched
    last_first = max(builds.values())
    assert sorted(counts[name] for name in touched) == list(range(last_first + 1, last_first + 1 + len(touched)))


def test_a_tile_that_differs_too_much_is_kept_and_may_be_accepted(updated, presight):
    workspace, _ = updated
    before, strict = generation(workspace), ("--set", "validation.min_geometry=1", "--set", "extraction.pixel_stride=7")
    answer = json.loads(run(presight, workspace.root, "update", CITY, *strict, "--json", "--accept", "t003", code=6))
    assert answer["published"] == ["t003"]
    assert generation(workspace).tiles["t000"] == before.tiles["t000"]
    assert "of the old voxels" in answer["failed"]["t000"]
