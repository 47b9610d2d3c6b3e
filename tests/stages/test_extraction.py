"""Extraction from a made-up field: a street between a wall and open ground, known by formula."""

import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from presight_core import classes, frames
from presight_core.cameras import Camera, pixel_centres
from presight_core.config import CitySettings
from presight_core.drives import FrameTable
from presight_core.errors import InputError
from presight_core.grid import Lattice, morton
from presight_core.pixels import FramePixels, PixelSource
from presight_core.priors import PriorReader
from presight_core.priors.documents import GenerationTile
from presight_core.priors.schema import array_specs, check_batch, unpack_columns, unpack_voxels
from presight_core.progress import Progress
from presight_core.tiles import Tile, Tiling
from stages import extraction
from stages.extraction import CameraHeights, TileExtraction, chosen_rows, extract_tile
from storage.priors import PriorStore
from storage.tile_groups import TileName

WIDTH, HEIGHT = 60, 40
GROUND_M, WALL_M, ROOF_M = 0.1, 6.1, 5.0  # ground height; the wall's y, and its top
EYE_M = 1.6
CHANNELS = 4
LEFT, RIGHT = 51, 204  # features of the images' halves
SPAN_M = 0.5  # more than a voxel
THIN_M = 12.0  # beyond this x the field is foggy: density below the filter
CITY = CitySettings.model_validate(
    {
        "training": {"holdout_every": 0},
        "extraction": {"frame_stride": 2, "pixel_stride": 2, "max_depth_m": 15.0, "above_camera_m": 3.0},
    }
)
ONE_TILE = Tiling("tiling", "town", (Tile("t000", (0.0, 0.0)),))
# Looking along +x, image y down: camera x is world -y, camera y is world -z.
WORLD_FROM_CAMERA = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def street_frames(count: int = 6, drives: tuple[str, ...] = ("drive-b", "drive-a")) -> FrameTable:
    """Cameras every 1.5 m along x, the same for every drive."""
    poses = np.tile(WORLD_FROM_CAMERA, (count, 1, 1))
    poses[:, 0, 3], poses[:, 2, 3] = np.arange(count) * 1.5, EYE_M
    intrinsics = np.array([[30.0, 0, WIDTH / 2], [0, 30.0, HEIGHT / 2], [0, 0, 1]])
    tables = [
        FrameTable(
            np.full(count, drive),
            np.full(count, "CAM_FRONT"),
            np.arange(count, dtype=np.int64) * 100_000,
            np.array([f"{drive}/{number}.jpg" for number in range(count)]),
            np.ones(count, np.int64),
            np.full(count, WIDTH, np.int32),
            np.full(count, HEIGHT, np.int32),
            np.tile(intrinsics, (count, 1, 1)),
            poses,
            np.ones(count, np.bool_),
        )
        for drive in drives
    ]
    return FrameTable.concatenate(tables)


class StreetPixels(PixelSource):
    """Labels of every frame: sky in the top quarter, a car in the lower left corner, else road.

    Features are one value left of the middle, and another one right of it.
    """

    features = np.stack([np.full((1, CHANNELS), value, np.uint8) for value in (LEFT, RIGHT)], 1)

    def load(self, row: int) -> FramePixels:
        labels = np.zeros((HEIGHT // 2, WIDTH // 2), np.uint8)
        labels[:5] = classes.SKY
        labels[-4:, :10] = classes.CITYSCAPES.index("car")
        return FramePixels(np.zeros((HEIGHT, WIDTH, 3), np.uint8), labels, self.features)


def frame_of(upper: int, lower: int) -> FramePixels:
    """A frame with one label above the horizon and one below."""
    labels = np.repeat(np.array([[upper], [lower]], np.uint8), [HEIGHT // 4, HEIGHT // 4], 0)
    return FramePixels(np.zeros((1, 1, 3), np.uint8), labels, np.zeros((1, 1, CHANNELS), np.uint8))


def street_surface(
    _field,
    origins: np.ndarray,
    directions: np.ndarray,
    surface: str,
    with_features: bool = True,
    fog_density: float = 0.0,
) -> extraction.SurfacePoints:
    """Where rays meet the ground, or the wall to the left below its roof; what stands behind is never seen.

    If spans are asked for, all are SPAN_M long.
    """
    assert surface in {"first-hit", "span"}
    with np.errstate(divide="ignore"):
        ground_m = (GROUND_M - origins[:, 2]) / directions[:, 2]
        wall_m = (WALL_M - origins[:, 1]) / directions[:, 1]
    ground_m[~(ground_m > 0)] = np.inf
    wall_m[~((wall_m > 0) & (origins[:, 2] + wall_m * directions[:, 2] < ROOF_M))] = np.inf
    depth = np.minimum(ground_m, wall_m)
    found = np.isfinite(depth)
    points = origins + np.where(found, depth, 1.0)[:, None] * directions
    density = np.where(points[:, 0] > THIN_M, 0.01, 3.0).astype(np.float32)
    found &= density >= fog_density  # beyond the thin part there is nothing
    features = np.stack([points[:, 0] / 40, wall_m < ground_m, np.full(len(points), 0.5), found], -1)
    return extraction.SurfacePoints(
        found,
        np.where(found, depth, 1.0).astype(np.float32),
        points,
        features.astype(np.float32) if with_features else np.zeros((len(points), 0), np.float32),
        np.full((len(points), 3), 0.2, np.float32),
        density,
        np.full(len(points), SPAN_M / 2 if surface == "span" else 0.0, np.float32),
    )


@pytest.fixture(autouse=True)
def street_field(monkeypatch):
    monkeypatch.setattr(extraction, "find_surface", street_surface)


def job_of(table: FrameTable, tiling: Tiling = ONE_TILE, tile: int = 0, city: CitySettings = CITY) -> TileExtraction:
    return TileExtraction(tile, tiling, Lattice(), table, city, CHANNELS)


def extracted(job: TileExtraction, scratch: Path):
    result = extract_tile(job, None, StreetPixels(), scratch)  # type: ignore[arg-type]
    return result, list(result.batches)


def voxels_of(batches) -> np.ndarray:
    blocks = [np.repeat(batch.block_index, np.diff(batch.block_start), axis=0) for batch in batches]
    packed = np.concatenate([batch.voxel for batch in batches])
    return unpack_voxels(packed, np.concatenate(blocks), Lattice())


def plain_extraction(job: TileExtraction) -> tuple[Counter, Counter]:
    """Hits of every voxel, and what each filter took, ray by ray."""
    hits, counts = Counter(), Counter()
    settings = job.settings.extraction
    for row in range(0, len(job.frames), settings.frame_stride):  # an even number of frames a drive
        camera, labels = job.frames.camera_of(row), StreetPixels().load(row).labels
        for pixel in pixel_centres(WIDTH, HEIGHT, settings.pixel_stride):
            counts["pixels"] += 1
            label = labels[int(pixel[1] / 2), int(pixel[0] / 2)]
            name = "sky" if label == classes.SKY else "dynamic" if label else plain_filter(job, camera, pixel)
            if isinstance(name, str):
                counts[name] += 1
            else:
                counts["points"] += 1
                hits[name] += 1
    return hits, counts


def plain_filter(job: TileExtraction, camera: Camera, pixel: np.ndarray) -> str | tuple[int, int, int]:
    settings = job.settings.extraction
    origin, directions = camera.rays(pixel[None])
    surface = street_surface(None, origin[None], directions, "first-hit")
    if not surface.found[0]:
        return "no_surface"
    point = surface.points_world[0]
    if not settings.min_depth_m <= surface.depth_m[0] <= settings.max_depth_m:
        return "depth"
    if not -settings.below_camera_m <= point[2] - EYE_M <= settings.above_camera_m:
        return "height"
    if surface.density[0] <= settings.min_density:
        return "density"
    voxel = np.floor(point / job.lattice.voxel_m).astype(int)
    centre = (voxel[:2] // 32 + 0.5) * 12.8
    distances = [np.linalg.norm(centre - tile.centroid_m) for tile in job.tiling.tiles]
    return tuple(voxel.tolist()) if np.argmin(distances) == job.tile else "foreign_block"


def test_voxels_hits_and_counts_equal_those_of_a_plain_loop(tmp_path: Path):
    tiling = replace(ONE_TILE, tiles=(Tile("t000", (0.0, 0.0)), Tile("t001", (15.0, -5.0))))
    job = job_of(street_frames(), tiling)
    hits, counts = plain_extraction(job)
    result, batches = extracted(job, tmp_path)
    kept = {voxel: count for voxel, count in hits.items() if count >= CITY.extraction.min_hits}
    found = zip(map(tuple, voxels_of(batches).tolist()), np.concatenate([batch.hits for batch in batches]), strict=True)
    assert dict(found) == kept
    assert all(counts[name] > 0 for name in ("sky", "dynamic", "no_surface", "depth", "height", "density", "points"))
    assert counts["foreign_block"] > 0
    assert result.counts == {**counts, "voxels": len(kept), "few_hits": len(hits) - len(kept)}


def test_every_pixel_is_counted_once(tmp_path: Path):
    counts = extracted(job_of(street_frames()), tmp_path)[0].counts
    taken = ("sky", "dynamic", "no_surface", "depth", "height", "density", "foreign_block", "points")
    assert sum(counts[name] for name in taken) == counts["pixels"] == 6 * (WIDTH // 2) * (HEIGHT // 2)


def test_voxels_lie_on_the_surfaces(tmp_path: Path):
    _, batches = extracted(job_of(street_frames()), tmp_path)
    voxels = voxels_of(batches)
    on_ground, on_wall = voxels[:, 2] == 0, voxels[:, 1] == 15  # 0.1 m and 6.1 m in voxels of 0.4 m
    assert (on_ground | on_wall).all()
    assert on_ground.sum() > 100
    assert on_wall.sum() > 30
    places = (np.concatenate([batch.centroid for batch in batches]) + 0.5) / 256
    np.testing.assert_allclose(places[on_ground & ~on_wall, 2], 0.25, atol=1 / 256)  # 0.1 m of 0.4 m
    np.testing.assert_allclose(places[on_wall & ~on_ground, 1], 0.25, atol=1 / 256)


def test_voxels_carry_the_fields_values_and_every_drive(tmp_path: Path):
    result, batches = extracted(job_of(street_frames()), tmp_path)
    voxels = voxels_of(batches)
    features = np.concatenate([batch.features for batch in batches])
    middle_m = (voxels[:, 0] + 0.5) * 0.4
    np.testing.assert_allclose(features[:, 0] / 255 * 40, middle_m, atol=0.3)  # within the voxel, and 1/255 of 40 m
    assert set(features[:, 2].tolist()) == {128}
    assert set(np.concatenate([batch.rgb for batch in batches]).ravel().tolist()) == {51}
    assert set(np.concatenate([batch.density for batch in batches]).tolist()) == {3.0}
    assert result.drives == ("drive-a", "drive-b")
    assert set(np.concatenate([batch.drives for batch in batches]).ravel().tolist()) == {0b11}


def test_voxels_can_have_the_features_of_the_images_that_saw_them(tmp_path: Path):
    """The cameras drive along y = 0, between two voxels."""
    city = CITY.model_copy(update={"extraction": CITY.extraction.model_copy(update={"features": "images"})})
    _, batches = extracted(job_of(street_frames(), city=city), tmp_path)
    features = np.concatenate([batch.features for batch in batches])
    is_left = voxels_of(batches)[:, 1] >= 0
    assert 0 < is_left.sum() < len(features)
    assert (features == np.where(is_left, LEFT, RIGHT)[:, None]).all()


@pytest.mark.parametrize(("span_m", "least", "most"), [(0.5, 1.8, 2.0), (0.01, 1.0, 1.2)])
def test_a_ray_marks_both_ends_of_its_surface_but_once_a_voxel_that_holds_both(
    tmp_path: Path, monkeypatch, span_m: float, least: float, most: float
):
    monkeypatch.setattr(sys.modules[__name__], "SPAN_M", span_m)
    points, lowest = {}, {}
    for rule in ("first-hit", "span"):
        city = CITY.model_copy(update={"extraction": CITY.extraction.model_copy(update={"surface": rule})})
        result, batches = extracted(job_of(street_frames(), city=city), tmp_path / rule)
        points[rule], lowest[rule] = result.counts["points"], voxels_of(batches)[:, 2].min()
    assert least < points["span"] / points["first-hit"] <= most
    assert lowest["first-hit"] == 0
    assert lowest["span"] == (-1 if span_m == 0.5 else 0)  # the ground lies at 0.1 m


def test_rays_go_through_fog(tmp_path: Path):
    clear = CITY.model_copy(update={"extraction": CITY.extraction.model_copy(update={"fog_density": 0.02})})
    held, through = (extracted(job_of(street_frames(), city=city), tmp_path)[0].counts for city in (CITY, clear))
    assert held["density"] > through["density"] == 0
    assert through["no_surface"] > held["no_surface"]
    assert through["voxels"] == held["voxels"]


def test_batches_are_sorted_and_valid(tmp_path: Path):
    _, batches = extracted(job_of(street_frames()), tmp_path)
    for batch in batches:
        check_batch(batch, array_specs(CHANNELS, 2, 32))
    keys = np.concatenate([morton(batch.block_index) for batch in batches]).tolist()
    assert keys == sorted(set(keys))


def observed_columns(batches) -> set[tuple[int, int]]:
    return {
        tuple((column + block * 32).tolist())
        for batch in batches
        for block, flags in zip(batch.block_index, unpack_columns(batch.observed), strict=True)
        for column in np.argwhere(flags)
    }


def test_columns_of_voxels_are_observed_and_those_behind_the_wall_are_not(tmp_path: Path):
    _, batches = extracted(job_of(street_frames()), tmp_path)
    observed = observed_columns(batches)
    assert {tuple(column) for column in voxels_of(batches)[:, :2].tolist()} <= observed
    assert (3, 0) in observed  # just ahead of the first camera: looked through
    assert max(y for _, y in observed) == 15  # the wall's own columns
    assert max(x for x, _ in observed) * 0.4 <= 4 * 1.5 + CITY.extraction.max_depth_m


def test_blocks_that_were_only_looked_through_are_listed_without_voxels(tmp_path: Path):
    foggy = CITY.model_copy(update={"extraction": CITY.extraction.model_copy(update={"min_density": 100.0})})
    result, batches = extracted(job_of(street_frames(), city=foggy), tmp_path)
    assert result.counts["points"] == result.counts["voxels"] == 0
    assert sum(len(batch.block_index) for batch in batches) > 1
    assert all(not np.diff(batch.block_start).any() for batch in batches)


def test_a_ray_that_leaves_the_mapped_heights_tells_nothing_about_the_ground_beyond(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(StreetPixels, "load", lambda _self, _row: frame_of(upper=0, lower=classes.SKY))
    high, low = [
        CITY.model_copy(update={"extraction": CITY.extraction.model_copy(update={"above_camera_m": above_m})})
        for above_m in (3.0, 0.1)
    ]
    beyond = observed_columns(extracted(job_of(street_frames(), city=high), tmp_path)[1])
    near = observed_columns(extracted(job_of(street_frames(), city=low), tmp_path)[1])
    assert near < beyond  # only rays that rise are left, and the lower ceiling cuts them short
    assert (0, 0) in near


def test_two_tiles_share_no_block(tmp_path: Path):
    tiling = replace(ONE_TILE, tiles=(Tile("t000", (0.0, 0.0)), Tile("t001", (15.0, -5.0))))
    blocks = [
        {tuple(block) for batch in batches for block in batch.block_index.tolist()}
        for tile in (0, 1)
        for _, batches in [extracted(job_of(street_frames(), tiling, tile), tmp_path / str(tile))]
    ]
    assert blocks[0] and blocks[1]
    assert not blocks[0] & blocks[1]


def test_extraction_of_the_same_frames_is_the_same(tmp_path: Path):
    first, second = (extracted(job_of(street_frames()), tmp_path)[1] for _ in range(2))
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.features, other.features)
        np.testing.assert_array_equal(one.hits, other.hits)


def test_what_was_extracted_is_read_back_around_the_vehicle(tmp_path: Path):
    result = extract_tile(job_of(street_frames()), None, StreetPixels(), tmp_path)  # type: ignore[arg-type]
    store = PriorStore.open(tmp_path / "store")
    store.create_city("town", Lattice(), "space", CHANNELS)
    entry = store.write_tile("town", TileName("t000", "build"), result.batches, result.drives, {})
    store.publish("town", {"t000": GenerationTile(entry, {})}, None, ONE_TILE.to_json())
    window = PriorReader.open(tmp_path / "store", "town").window(frames.planar_transform(4.0, 0.0, np.pi))
    assert len(window) == result.counts["voxels"] == entry.voxel_count
    distances = np.minimum(abs(window.points_world[:, 2] - GROUND_M), abs(window.points_world[:, 1] - WALL_M))
    assert distances.max() < 0.4 / 256  # the step of a stored centroid
    np.testing.assert_allclose(window.points_ego[:, 0], 4.0 - window.points_world[:, 0], atol=1e-5)


def test_progress_reaches_its_total(tmp_path: Path):
    seen: list[Progress] = []
    extract_tile(job_of(street_frames()), None, StreetPixels(), tmp_path, seen.append)  # type: ignore[arg-type]
    assert [(progress.done, progress.total) for progress in seen] == [(done, 6) for done in range(1, 7)]


def test_frames_of_nothing_but_sky_are_no_trouble(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(StreetPixels, "load", lambda _self, _row: frame_of(upper=classes.SKY, lower=classes.SKY))
    result, batches = extracted(job_of(street_frames()), tmp_path)
    assert result.counts["sky"] == result.counts["pixels"]
    assert batches == []


def test_a_field_of_another_feature_space_is_an_input_error(tmp_path: Path):
    with pytest.raises(InputError, match="4 channels, the feature space 5"):
        extracted(replace(job_of(street_frames()), feature_channels=5), tmp_path)


def test_every_second_training_frame_of_a_camera_is_chosen_and_no_held_out_one():
    table = street_frames(count=9, drives=("a", "b"))
    city = CITY.model_copy(update={"training": CITY.training.model_copy(update={"holdout_every": 4})})
    # Of nine frames, 2 and 6 are held out; of the others, every second is taken.
    assert sorted(chosen_rows(job_of(table, city=city))) == [0, 3, 5, 8, 9, 12, 14, 17]


def test_heights_follow_a_hill():
    x = np.arange(0, 200, 1.0)
    heights = CameraHeights(np.stack([x, np.zeros_like(x), x * 0.1], -1))
    points = np.array([[50.0, 10.0, 0.0], [150.0, -20.0, 0.0]])
    np.testing.assert_allclose(heights.at(points), [5.0, 15.0], atol=0.3)


def test_a_parked_vehicle_does_not_outvote_the_road():
    road = np.array([[0.0, 0.0, 0.0], [2.5, 0.0, 1.0], [5.0, 0.0, 2.0]])
    parked = np.repeat([[7.5, 0.0, 9.0]], 1000, 0)
    assert CameraHeights(np.concatenate([road, parked])).at(np.zeros((1, 3)))[0] == pytest.approx(3.0)


def test_one_camera_is_enough_for_a_height():
    assert CameraHeights(np.array([[1.0, 2.0, 3.0]])).at(np.zeros((2, 3))).tolist() == [3.0, 3.0]
