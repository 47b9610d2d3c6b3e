"""Averaging surface points in voxels."""

import tracemalloc
from collections import defaultdict
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from presight_core.grid import Lattice, morton
from presight_core.priors.schema import unpack_voxels
from stages.voxel_sums import CELLS, SUPERBLOCK, Samples, VoxelSums

LATTICE = Lattice()
CHANNELS = 3


def samples(count: int, seed: int, spread_m: float = 30.0) -> Samples:
    random = np.random.default_rng(seed)
    points = random.normal(0, [spread_m, spread_m, 1.0], (count, 3))
    points = np.repeat(points[::3], 3, 0)[:count] + random.normal(0, 0.1, (count, 3))  # several in a voxel
    unit = random.random((count, CHANNELS + 3), np.float32)
    return Samples(points, unit[:, :CHANNELS], unit[:, CHANNELS:], random.gamma(2, 2, count).astype(np.float32))


def plain_means(batches: list[tuple[Samples, int]], min_hits: int) -> dict[tuple, dict]:
    """Voxels and their means, one point after the other."""
    points_of_voxel = defaultdict(list)
    for batch, drive in batches:
        for index, point in enumerate(batch.points_world):
            voxel = np.floor(point / LATTICE.voxel_m).astype(int)
            place = point / LATTICE.voxel_m - voxel
            values = batch.features[index], place, batch.rgb[index], batch.density[index], drive
            points_of_voxel[tuple(voxel.tolist())].append(values)
    return {
        voxel: {
            "hits": len(points),
            "features": np.mean([point[0] for point in points], 0) * 255,
            "centroid": np.mean([point[1] for point in points], 0) * 256,
            "rgb": np.mean([point[2] for point in points], 0) * 255,
            "density": np.mean([point[3] for point in points]),
            "drives": sum({1 << point[4] for point in points}),
        }
        for voxel, points in points_of_voxel.items()
        if len(points) >= min_hits
    }


def stored_means(sums: VoxelSums) -> dict[tuple, dict]:
    found = {}
    for superblock in sums.superblocks:
        means = sums.means(superblock)
        blocks = (CELLS[means.cell] + np.array(superblock) * SUPERBLOCK).astype(np.int32)
        for row, voxel in enumerate(unpack_voxels(means.voxel, blocks, LATTICE).tolist()):
            found[tuple(voxel)] = {
                name: getattr(means, name)[row] for name in ("hits", "features", "centroid", "rgb", "density", "drives")
            }
    return found


@pytest.mark.parametrize("memory_rows", [1 << 19, 200], ids=["in memory", "spilling"])
def test_means_equal_those_of_a_plain_loop(tmp_path: Path, memory_rows: int):
    batches = [(samples(400, seed), seed % 3) for seed in range(6)]
    sums = VoxelSums(LATTICE, CHANNELS, 3, tmp_path, memory_rows)
    for batch, drive in batches:
        sums.add(batch, drive)
    kept, dropped = sums.finish(min_hits=2)
    expected, found = plain_means(batches, min_hits=2), stored_means(sums)
    assert found.keys() == expected.keys()
    assert (kept, kept + dropped) == (len(expected), len(plain_means(batches, min_hits=1)))
    assert dropped > 0
    for voxel, mean in expected.items():
        stored = found[voxel]
        assert stored["hits"] == mean["hits"]
        assert stored["drives"].tolist() == [mean["drives"]]
        np.testing.assert_allclose(stored["features"], mean["features"], atol=0.51)
        np.testing.assert_allclose(stored["rgb"], mean["rgb"], atol=0.51)
        np.testing.assert_allclose(stored["centroid"] + 0.5, mean["centroid"], atol=0.51)
        assert stored["density"] == pytest.approx(mean["density"], rel=1e-3)


def test_spilling_changes_no_voxel_and_hardly_a_mean(tmp_path: Path):
    whole, spilling = [
        VoxelSums(LATTICE, CHANNELS, 1, tmp_path / name, rows) for name, rows in (("a", 1 << 19), ("b", 100))
    ]
    for sums, folder in ((whole, "a"), (spilling, "b")):
        (tmp_path / folder).mkdir()
        for seed in range(5):
            sums.add(samples(500, seed), 0)
    assert whole.finish(1) == spilling.finish(1)
    assert whole.superblocks == spilling.superblocks
    for superblock in whole.superblocks:
        ours, theirs = whole.means(superblock), spilling.means(superblock)
        np.testing.assert_array_equal(ours.voxel, theirs.voxel)
        np.testing.assert_array_equal(ours.hits, theirs.hits)
        assert np.abs(ours.features.astype(int) - theirs.features).max() <= 1  # another order of summing


def test_voxels_of_a_superblock_ascend_by_block_then_voxel(tmp_path: Path):
    sums = VoxelSums(LATTICE, CHANNELS, 1, tmp_path, 300)
    for seed in range(4):
        sums.add(samples(600, seed), 0)
    sums.finish(1)
    for superblock in sums.superblocks:
        means = sums.means(superblock)
        order = list(zip(means.cell.tolist(), means.voxel.tolist(), strict=True))
        assert order == sorted(set(order))


def test_cells_follow_the_morton_order_of_blocks_anywhere():
    for superblock in [(0, 0), (-1, 5), (-7, -3)]:
        keys = morton(CELLS + np.array(superblock) * SUPERBLOCK).tolist()
        assert keys == sorted(keys)


def test_forty_drives_fit_in_the_bit_set(tmp_path: Path):
    sums = VoxelSums(LATTICE, CHANNELS, 40, tmp_path)
    one = samples(1, 0)
    for drive in (0, 33, 39):
        sums.add(one, drive)
    sums.finish(1)
    (superblock,) = sums.superblocks
    assert sums.means(superblock).drives.tolist() == [[1, 1 << 1 | 1 << 7]]


def test_no_points_make_no_voxels(tmp_path: Path):
    sums = VoxelSums(LATTICE, CHANNELS, 1, tmp_path)
    sums.add(samples(1, 0).select(np.array([], np.int64)), 0)
    assert sums.finish(1) == (0, 0)
    assert sums.superblocks == set()
    means = sums.means((0, 0))
    assert {len(getattr(means, field.name)) for field in fields(means)} == {0}


def peak_bytes_of(scratch: Path, frame_count: int) -> tuple[int, int]:
    """Peak memory, and bytes of all voxel sums, of a drive of so many frames, 3 m apart."""
    scratch.mkdir()
    random = np.random.default_rng(0)
    features = random.random((2000, 64), np.float32)
    tracemalloc.start()
    sums = VoxelSums(LATTICE, 64, 1, scratch, memory_rows=4000)
    for frame in range(frame_count):
        points = random.normal([frame * 3.0, 0, 0], [15, 15, 1], (2000, 3))
        sums.add(Samples(points, features, features[:, :3], features[:, 0]), 0)
    kept, _ = sums.finish(1)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak, kept * 300  # bytes a row


@pytest.mark.slow
def test_memory_does_not_grow_with_the_number_of_points(tmp_path: Path):
    peak_bytes_of(tmp_path / "warm", 1)  # compiles the kernel
    short_peak, short_sums = peak_bytes_of(tmp_path / "short", 40)
    long_peak, long_sums = peak_bytes_of(tmp_path / "long", 120)
    assert long_sums > 2.5 * short_sums
    assert long_peak < 1.2 * short_peak
    assert long_peak < long_sums / 2
