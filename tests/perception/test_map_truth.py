"""Ground truth from a made-up map: a crossroads with an island, two crossings and three dividers."""

import json
import pickle

import numpy as np
import pytest
import shapely

from presight_core import frames
from presight_core.errors import InputError, NotFoundError
from presight_perception.map_truth import (
    MAP_CLASSES,
    MapTruthSettings,
    RasterSettings,
    VectorMap,
    rasterise,
)
from tests.perception.toy_map import box, crossroads

HERE = frames.planar_transform(100.0, 200.0, 0.0)  # in the middle of the crossroads
SETTINGS = MapTruthSettings(60.0, 30.0)


@pytest.fixture
def city() -> VectorMap:
    return VectorMap.from_tables(crossroads().tables)


def bounds(line: np.ndarray) -> list[float]:
    return np.round([*line.min(0), *line.max(0)], 6).tolist()


def test_dividers_of_lanes_and_roads_end_at_the_range(city):
    found = city.lines(HERE, SETTINGS)["divider"]
    assert sorted(map(bounds, found)) == [[-30, 1, -6, 1], [0, 10, 0, 15], [6, 0, 30, 0]]


def test_crossings_are_closed_outlines(city):
    found = city.lines(HERE, SETTINGS)["ped_crossing"]
    assert sorted(map(bounds, found)) == [[-5, 8, 5, 11], [8, -6, 10, 6]]
    for line in found:
        np.testing.assert_array_equal(line[0], line[-1])


def test_a_crossing_is_closed_along_the_edge_that_cuts_it(city):
    found = city.lines(HERE, MapTruthSettings(60.0, 20.0))["ped_crossing"]
    assert [-5, 8, 5, 10] in map(bounds, found)


def test_parallel_crossings_that_touch_are_one():
    tables = crossroads()
    tables.surface("ped_crossing", box(8, 6, 10, 9))  # goes on where the first one ends
    tables.surface("ped_crossing", box(8, 9, 10, 12))  # and on
    found = VectorMap.from_tables(tables.tables).lines(HERE, SETTINGS)["ped_crossing"]
    assert [8, -6, 10, 12] in map(bounds, found)
    assert len(found) == 2


def test_touching_crossings_of_different_directions_stay_two():
    tables = crossroads()
    tables.surface("ped_crossing", box(-10, 6, 8.5, 8))
    found = VectorMap.from_tables(tables.tables).lines(HERE, SETTINGS)["ped_crossing"]
    assert [8, -6, 10, 6] in map(bounds, found)


def test_boundaries_are_the_edges_of_all_road_surfaces_together(city):
    found = city.lines(HERE, SETTINGS)["boundary"]
    assert sorted(map(bounds, found)) == [
        [-29.8, -14.8, -5, -6],
        [-29.8, 6, -5, 14.8],
        [5, -14.8, 29.8, -6],
        [5, 6, 29.8, 14.8],
        [20, -2, 24, 2],
    ]


def test_the_road_is_on_the_right_of_its_boundaries(city):
    """Outer edges run clockwise around the surface, those of islands counter-clockwise."""
    road = shapely.union_all([shapely.box(-80, -6, 80, 6), shapely.box(-5, -60, 5, 60)])
    road = road.difference(shapely.box(20, -2, 24, 2))
    for line in city.lines(HERE, SETTINGS)["boundary"]:
        ahead = line[1] - line[0]
        right = np.array([ahead[1], -ahead[0]]) / np.linalg.norm(ahead)
        assert road.contains(shapely.Point((line[0] + line[1]) / 2 + 0.1 * right))


def test_lines_turn_with_the_vehicle_and_ignore_its_tilt(city):
    level = frames.planar_transform(100.0, 200.0, np.pi / 2)
    tilted = level @ frames.transform(frames.rotation_from_quaternion([1.0, 0.02, 0.03, 0.0]), [0.0, 0.0, 0.0])
    found = city.lines(level, SETTINGS)["divider"]
    assert sorted(map(bounds, found)) == [[0, -15, 0, -6], [1, 6, 1, 15], [10, 0, 30, 0]]
    for line, other in zip(found, city.lines(tilted, SETTINGS)["divider"], strict=True):
        np.testing.assert_allclose(line, other, atol=0.1)  # the little that the tilt turns the heading


def test_there_is_nothing_away_from_the_city(city):
    assert city.lines(np.eye(4), SETTINGS) == {name: [] for name in MAP_CLASSES}


def test_a_range_inside_the_road_has_no_boundary(city):
    assert city.lines(HERE, MapTruthSettings(8.0, 8.0))["boundary"] == []


def test_vertices_that_move_little_are_left_out():
    tables = crossroads()
    tables.line("lane_divider", [(-20, -4), (-15, -3.9), (-10, -4)])
    found = VectorMap.from_tables(tables.tables).lines(HERE, SETTINGS)["divider"]
    assert {len(line) for line in found} == {2}


def test_a_surface_that_crosses_itself_is_mended():
    tables = crossroads()
    tables.surface("lane", [(10, 10), (14, 14), (14, 10), (10, 14)])
    found = VectorMap.from_tables(tables.tables).lines(HERE, SETTINGS)["boundary"]
    assert len(found) == 7  # two triangles more


def test_a_record_without_a_line_is_passed_over():
    tables = crossroads()
    tables.line("lane_divider", [])
    assert len(VectorMap.from_tables(tables.tables).lines(HERE, SETTINGS)["divider"]) == 3


def test_a_file_is_read_like_its_tables(tmp_path, city):
    file = tmp_path / "boston-seaport.json"
    file.write_text(json.dumps({"version": "1.3", **crossroads().tables}))
    found, expected = VectorMap.read(file).lines(HERE), city.lines(HERE)
    assert {name: [line.tolist() for line in lines] for name, lines in found.items()} == {
        name: [line.tolist() for line in lines] for name, lines in expected.items()
    }


def test_a_map_reaches_worker_processes(city):
    sent = pickle.loads(pickle.dumps(city))  # noqa: S301
    assert len(sent.lines(HERE, SETTINGS)["boundary"]) == 5


def test_an_absent_map_is_named(tmp_path):
    with pytest.raises(NotFoundError, match=r"nowhere.json does not exist"):
        VectorMap.read(tmp_path / "nowhere.json")


@pytest.mark.parametrize("content", ["{", "[]", '{"node": []}'])
def test_what_is_no_map_is_an_error(tmp_path, content):
    file = tmp_path / "map.json"
    file.write_text(content)
    with pytest.raises(InputError, match="not a map expansion"):
        VectorMap.read(file)


def test_rows_start_at_the_right_and_columns_behind():
    lines = {"ped_crossing": [], "divider": [np.array([[0.0, -10.0], [20.0, -10.0]])], "boundary": []}
    masks = rasterise(lines, SETTINGS, RasterSettings(30, 60, thickness_px=1))
    assert not masks[[0, 2]].any()
    rows, columns = np.nonzero(masks[1])
    assert set(rows) == {5}
    assert (columns.min(), columns.max()) == (30, 50)


def test_thin_lines_lie_inside_thick_ones_and_cover_far_less(city):
    lines = city.lines(HERE)
    thin, thick = (rasterise(lines, MapTruthSettings(), RasterSettings(thickness_px=px)) for px in (1, 5))
    assert (thick >= thin).all()
    assert 0 < 4 * thin.sum() < thick.sum()
