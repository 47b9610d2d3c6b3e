"""The commands that look after a city's store."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from flows.cli import app
from presight_core.errors import ConflictError, NotFoundError, SettingsError, StoreError
from presight_core.priors import PriorReader
from presight_core.priors.documents import GenerationTile
from presight_core.priors.example import ExampleTile
from storage.priors import PriorStore
from storage.tile_groups import TileName

TILING = {"tiling_id": "one", "city": "town", "tiles": [{"tile_id": "t000", "centroid_m": [0.0, 0.0]}]}


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    """A workspace whose store has two generations of one tile."""
    store = PriorStore.open(tmp_path / "store")
    example = ExampleTile(side_blocks=2)
    store.create_city("town", example.lattice, "space-1", example.channel_count)
    for seed, parent in enumerate([None, 1]):
        batches = ExampleTile(side_blocks=2, seed=seed).batches()
        entry = store.write_tile("town", TileName("t000", f"build-{seed}"), batches, ["a", "b", "c"], {})
        store.publish("town", {"t000": GenerationTile(entry, {"seed": seed})}, parent, TILING)
    return tmp_path


def run(workspace: Path, *arguments: str) -> str:
    result = CliRunner().invoke(app, ["--workspace", str(workspace), *arguments])
    if result.exception:
        raise result.exception
    return result.stdout


def test_verify_tells_that_all_is_well(workspace: Path):
    answer = json.loads(run(workspace, "verify", "town", "--deep", "--json"))
    assert (answer["generations"], answer["builds"], answer["faults"]) == (2, 2, [])
    assert "0 faults" in run(workspace, "verify", "town")


def test_verify_fails_and_names_the_damaged_object(workspace: Path):
    chunk = workspace / "store/town/tiles/t000/build-1/rgb/c/0/0"
    chunk.write_bytes(chunk.read_bytes()[:-1] + b"?")
    result = CliRunner().invoke(app, ["--workspace", str(workspace), "verify", "town", "--deep"])
    assert isinstance(result.exception, StoreError)
    assert "town/tiles/t000/build-1/rgb/c/0/0" in result.stdout


def test_log_shows_the_newest_first_and_what_changed(workspace: Path):
    run(workspace, "tag", "town", "release", "--generation", "1")
    newest, oldest = json.loads(run(workspace, "log", "town", "--json"))
    assert (newest["generation"], newest["changed"], newest["voxels"]) == (2, ["t000"], 150)
    assert oldest["tags"] == ["release"]
    assert "release" in run(workspace, "log", "town")


def test_rollback_shows_the_earlier_tiles_as_a_new_generation(workspace: Path):
    assert "generation 3 shows what generation 1 did" in run(workspace, "rollback", "town", "1")
    reader = PriorReader.open(workspace / "store", "town")
    assert reader.generation.tiles["t000"].recipe == {"seed": 0}
    assert json.loads(run(workspace, "log", "town", "--json"))[0]["restores"] == 1


def test_tags_are_set_shown_and_taken_away(workspace: Path):
    run(workspace, "tag", "town", "release")
    assert "release" in run(workspace, "tag", "town")
    run(workspace, "tag", "town", "release", "--remove")
    assert "release" not in run(workspace, "tag", "town")
    with pytest.raises(SettingsError):
        run(workspace, "tag", "town", "--remove")


def test_gc_shows_first_and_removes_then(workspace: Path):
    arguments = ("gc", "town", "--keep", "1", "--grace-days", "0")
    shown = json.loads(run(workspace, *arguments, "--dry-run", "--json"))
    assert shown["builds"] == ["town/tiles/t000/build-0"]
    assert (workspace / "store/town/tiles/t000/build-0/zarr.json").exists()
    assert "are gone" in run(workspace, *arguments)
    assert not (workspace / "store/town/tiles/t000/build-0/zarr.json").exists()
    assert "0 faults" in run(workspace, "verify", "town", "--deep")


def test_diff_counts_and_draws_the_changes(workspace: Path, tmp_path: Path):
    run(workspace, "tag", "town", "release", "--generation", "1")
    answer = json.loads(run(workspace, "diff", "town", "release", "2", "--png", str(tmp_path / "d.png"), "--json"))
    counts = answer["tiles"]["t000"]
    assert counts["added"] + counts["changed"] + counts["same"] == 150
    assert counts["added"] == counts["removed"] > 100  # two random tiles share few voxels
    colours = np.unique(np.asarray(Image.open(tmp_path / "d.png")).reshape(-1, 3), axis=0).tolist()
    assert [0, 114, 178] in colours
    assert [213, 60, 0] in colours


def test_generations_that_show_the_same_do_not_differ(workspace: Path):
    run(workspace, "rollback", "town", "1")
    assert json.loads(run(workspace, "diff", "town", "1", "3", "--json"))["tiles"] == {}


@pytest.mark.parametrize(
    ("layout", "file"),
    [("presight-legacy", "town-c0.pkl"), ("npy", "layout.json"), ("ply", "town.ply"), ("stac", "catalog.json")],
)
def test_every_layout_is_written_whole_and_once(workspace: Path, tmp_path: Path, layout: str, file: str):
    arguments = ("export", "town", "--layout", layout, "--out", str(tmp_path / "out"))
    run(workspace, *arguments)
    assert (tmp_path / "out/town" / file).stat().st_size > 0
    with pytest.raises(ConflictError, match="is there"):
        run(workspace, *arguments)


def test_what_was_exported_can_be_imported(workspace: Path, tmp_path: Path):
    run(workspace, "export", "town", "--layout", "presight-legacy", "--out", str(tmp_path / "out"))
    assert "150 voxels" in run(workspace, "import", "again", str(tmp_path / "out/town/town-c0.pkl"))
    wide = {"x_m": (-90, 90), "y_m": (-90, 90), "z_m": (-90, 90)}
    before, after = (
        PriorReader.open(workspace / "store", city).window(np.eye(4), **wide) for city in ("town", "again")
    )
    np.testing.assert_array_equal(after.hits, before.hits)
    np.testing.assert_allclose(after.points_world, before.points_world, atol=0.4 / 256)
    np.testing.assert_array_equal(after.features, before.features)
    assert "0 faults" in run(workspace, "verify", "again", "--deep")


@pytest.mark.parametrize(
    "arguments", [("log", "x"), ("verify", "x"), ("gc", "x"), ("rollback", "town", "9"), ("diff", "town", "1", "9")]
)
def test_what_does_not_exist_is_not_found(workspace: Path, arguments: tuple[str, ...]):
    with pytest.raises(NotFoundError):
        run(workspace, *arguments)
