"""How far two builds of a tile agree about what both saw."""

from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from presight_core.grid import Lattice
from presight_core.priors.agreement import Agreement, agreement
from presight_core.priors.documents import GenerationTile
from presight_core.priors.schema import VoxelBatch, pack_columns, pack_voxels
from presight_core.priors.tile_table import TileTable
from storage.priors import PriorStore
from storage.tile_groups import TileName

SIDE, CHANNELS = 32, 8  # one block
GROUND = np.argwhere(np.ones((SIDE, SIDE, 1)))
WALL = np.array([(20, y, z) for y in range(SIDE) for z in range(1, 9)])
STREET = np.concatenate([GROUND, WALL])
SAME = Agreement(coverage=1.0, old_found=1.0, new_found=1.0, feature_cosine=pytest.approx(1.0))  # type: ignore[arg-type]


@dataclass
class Prior:
    """A made-up build of one block."""

    voxels: NDArray[np.int64] = None  # type: ignore[assignment]
    drives: tuple[str, ...] = ("a", "b")
    bits: NDArray[np.int64] | int = 3  # which drives saw each voxel
    observed: NDArray[np.bool_] = None  # type: ignore[assignment]
    noise: float = 0.0

    def __post_init__(self) -> None:
        self.voxels = STREET if self.voxels is None else self.voxels
        self.observed = np.ones((SIDE, SIDE), np.bool_) if self.observed is None else self.observed

    def batch(self) -> VoxelBatch:
        words = pack_voxels(self.voxels, Lattice())
        order, total = np.argsort(words), len(words)
        look = np.random.default_rng(0).uniform(0, 255, (64, CHANNELS))[self.voxels.sum(-1) % 64]
        look = np.clip(look + self.noise * np.random.default_rng(1).normal(size=look.shape), 0, 255)
        bits = np.broadcast_to(self.bits, total).astype(np.uint32)[:, None]
        return VoxelBatch(
            block_index=np.zeros((1, 2), np.int32),
            block_start=np.array([0, total], np.int64),
            observed=pack_columns(self.observed[None]),
            voxel=words[order],
            centroid=np.zeros((total, 3), np.uint8),
            features=look[order].astype(np.uint8),
            hits=np.ones(total, np.uint32),
            density=np.ones(total, np.float16),
            rgb=np.zeros((total, 3), np.uint8),
            drives=bits[order],
        )


@pytest.fixture
def compare(tmp_path: Path):
    """The agreement of two made-up builds, written and read."""
    store = PriorStore.open(tmp_path)
    store.create_city("town", Lattice(), "space", CHANNELS)

    def written(prior: Prior) -> TileTable:
        name = TileName("t000", f"build-{next(numbers)}")
        entry = store.write_tile("town", name, [prior.batch()], prior.drives, {})
        return store.table("town", GenerationTile(entry, {}))

    numbers = count()
    return lambda old, new: agreement(written(old), written(new))


def test_a_build_agrees_with_itself(compare):
    assert compare(Prior(), Prior()) == SAME


def test_a_step_of_one_voxel_is_agreement_and_a_greater_one_is_not(compare):
    near = compare(Prior(WALL), Prior(WALL + np.array([1, 0, 0])))
    far = compare(Prior(WALL), Prior(WALL + np.array([2, 0, 0])))
    assert (near.old_found, near.new_found) == (1.0, 1.0)
    assert (far.old_found, far.new_found) == (0.0, 0.0)


def test_a_lost_wall_is_missed_by_the_old_voxels_only(compare):
    found = compare(Prior(), Prior(GROUND))
    # Its lowest voxels and those beside the ground are within a voxel of the ground.
    assert found.old_found == pytest.approx(1 - 7 * SIDE / len(STREET))
    assert found.new_found == 1.0


def test_fog_is_missed_by_the_new_voxels_only(compare):
    fog = np.array([(x, y, 20) for x in range(SIDE) for y in range(SIDE)])
    found = compare(Prior(), Prior(np.concatenate([STREET, fog])))
    assert (found.old_found, found.new_found) == (1.0, pytest.approx(len(STREET) / (len(STREET) + len(fog))))


def test_what_a_new_drive_alone_saw_is_not_held_against_the_new_build(compare):
    tower = np.array([(5, 5, z) for z in range(2, 30)])
    bits = np.concatenate([np.full(len(STREET), 3), np.full(len(tower), 4)])
    assert compare(Prior(), Prior(np.concatenate([STREET, tower]), ("a", "b", "c"), bits)) == SAME


def test_what_only_a_removed_drive_saw_may_be_lost(compare):
    bits = np.where(STREET[:, 0] < 16, 1, 2)  # drive b saw the half with the wall
    kept = STREET[STREET[:, 0] < 16]
    half = np.zeros((SIDE, SIDE), np.bool_)
    half[:16] = True
    assert compare(Prior(bits=bits), Prior(kept, ("a",), 1, half)) == SAME


def test_what_a_drive_that_is_left_saw_may_not_be_lost(compare):
    bits = np.where(STREET[:, 0] < 16, 1, 2)
    quarter = np.zeros((SIDE, SIDE), np.bool_)
    quarter[:8] = True
    found = compare(Prior(bits=bits), Prior(STREET[STREET[:, 0] < 8], ("a",), 1, quarter))
    assert found.coverage == 0.5


def test_ground_that_the_new_build_did_not_observe_counts_as_lost_coverage_only(compare):
    quarter = np.zeros((SIDE, SIDE), np.bool_)
    quarter[:8] = True
    found = compare(Prior(), Prior(STREET[STREET[:, 0] < 8], observed=quarter))
    assert found == replace(SAME, coverage=0.25)


def test_features_that_changed_lower_the_cosine_and_nothing_else(compare):
    little, much = compare(Prior(), Prior(noise=20)), compare(Prior(), Prior(noise=1000))
    assert 0.9 < little.feature_cosine < 0.99
    assert abs(much.feature_cosine) < 0.5
    assert (much.coverage, much.old_found, much.new_found) == (1.0, 1.0, 1.0)


def test_builds_without_a_common_drive_are_not_compared(compare):
    assert compare(Prior(), Prior(drives=("c", "d"))) is None


def test_an_empty_build_lost_everything(compare):
    empty = Prior(np.zeros((0, 3), np.int64), observed=np.zeros((SIDE, SIDE), np.bool_))
    assert compare(Prior(), empty) == Agreement(coverage=0.0, old_found=1.0, new_found=1.0, feature_cosine=1.0)
