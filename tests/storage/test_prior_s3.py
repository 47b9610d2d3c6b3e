"""The same store on a real S3 server: one code path."""

import multiprocessing
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import obstore
import pytest

from presight_core import frames
from presight_core.errors import StoreError
from presight_core.priors import PriorReader
from storage.priors import PriorStore
from storage.retention import Retention, collect
from storage.verification import verify_city

POSES = [frames.planar_transform(x, -2.0, yaw) for x, yaw in [(0.0, 0.0), (9.0, 1.0), (-11.0, 2.5)]]


@pytest.fixture
def remote(town, s3: str):
    """The town of these tests, on a folder and at a URL of its own."""
    store = PriorStore.open(s3)
    store.create_city("town", town.example.lattice, "space-1", town.example.channel_count)
    there = replace(town, location=s3, store=store)
    store.publish("town", {"t000": there.write("t000", "build-1")}, None, town.tiling)
    return there


def hits_of(reader: PriorReader) -> int:
    return int(reader.window(POSES[0]).hits.sum())


def test_a_store_on_s3_reads_like_a_folder(town, remote):
    here, there = town.reader(), remote.reader()
    assert there.generation.tiles["t000"].entry.digest == here.generation.tiles["t000"].entry.digest
    for window, expected in zip(there.windows(POSES), here.windows(POSES), strict=True):
        np.testing.assert_array_equal(window.points_world, expected.points_world)
        np.testing.assert_array_equal(window.features, expected.features)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.map(hits_of, [there]) == [hits_of(here)]


def test_a_store_on_s3_is_looked_after_like_a_folder(remote):
    store = remote.store
    store.publish("town", {"t000": remote.write("t000", "build-2", replace(remote.example, seed=1))}, 1)
    store.tag("town", "release", 2)
    assert store.rollback("town", 1) == 3
    assert verify_city(remote.location, "town", deep=True).faults == []
    garbage = collect(remote.location, "town", Retention(keep=1), datetime.now(UTC) + timedelta(days=30))
    assert (garbage.generations, garbage.builds) == ((1,), ())  # the tag keeps generation 2, and 3 shows build 1
    store.remove_tag("town", "release")
    garbage = collect(remote.location, "town", Retention(keep=1), datetime.now(UTC) + timedelta(days=30))
    assert (garbage.generations, garbage.builds) == ((2,), ("town/tiles/t000/build-2",))
    assert verify_city(remote.location, "town", deep=True).faults == []


def test_a_chunk_lost_on_s3_is_an_error_and_is_found(remote):
    path = "town/tiles/t000/build-1/hits/c/0"
    obstore.delete(remote.store._objects, path)
    with pytest.raises(StoreError, match="hits/c/0 is missing"):
        remote.reader().window(POSES[0])
    assert any(fault.path == path for fault in verify_city(remote.location, "town").faults)
