"""Reading for weeks: neither files nor memory are left behind."""

import gc
import os
from pathlib import Path

import numpy as np
import pytest

from presight_core import frames
from presight_core.priors import PriorReader, schema


def open_files() -> int:
    return len(os.listdir("/proc/self/fd"))  # noqa: PTH208 - a Path would open it once more


def many_windows_leak_nothing(empty_town, monkeypatch, count: int) -> None:
    monkeypatch.setattr(schema, "CHUNK_ROWS", 128)
    empty_town.store.publish("town", {"t000": empty_town.write("t000", "build-1")}, None, empty_town.tiling)
    reader = PriorReader.open(empty_town.location, "town", cache_bytes=6_000)  # a chunk or two: most are read anew
    random = np.random.default_rng(0)
    reader.window(frames.planar_transform(3.0, -2.0, 0.0))
    gc.collect()  # what earlier tests left open
    before = open_files()
    most_memory = 0
    for number in range(count):
        pose = frames.planar_transform(*random.uniform(-40, 40, 2), random.uniform(0, 7))
        reader.window(pose, (-3.0, 3.0), (-3.0, 3.0))
        if number == count // 10:
            most_memory = resident_bytes()
    assert open_files() <= before
    assert resident_bytes() < most_memory + 2e6 + 40 * count  # a window holds more than 2 kB, a chunk 1 kB


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def test_a_thousand_windows_leak_neither_files_nor_memory(empty_town, monkeypatch):
    many_windows_leak_nothing(empty_town, monkeypatch, 1_000)


@pytest.mark.slow
def test_a_hundred_thousand_windows_leak_neither_files_nor_memory(empty_town, monkeypatch):
    many_windows_leak_nothing(empty_town, monkeypatch, 100_000)
