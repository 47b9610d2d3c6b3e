"""City blocks: what stands between the streets."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon

from presight_core.synthetic.buildings import FLOOR_M, Building, BuildingKind, add_building, window_seeds
from presight_core.synthetic.ground import CURB_M, Terrain
from presight_core.synthetic.layers import polygons
from presight_core.synthetic.materials import Material
from presight_core.synthetic.mesh import BOX_FACES, Box, MeshBuilder, Surface
from presight_core.synthetic.style import BRICK, GLASS, CityStyle, Colour

LAWN = (0.17, 0.27, 0.08)
PAVING = (0.46, 0.43, 0.39)


@dataclass
class Site:
    """What the parts of a city under construction share."""

    builder: MeshBuilder
    rng: np.random.Generator
    style: CityStyle
    terrain: Terrain
    trees: list[NDArray[np.float64]] = field(default_factory=list)  # (2,) each
    lamps: list[NDArray[np.float64]] = field(default_factory=list)  # (3,) light heads
    instance_count: int = 0

    def next_instance(self) -> int:
        """A new object number, from 1."""
        self.instance_count += 1
        return self.instance_count


@dataclass(frozen=True)
class Plots:
    """How densely a kind of block is built; ranges in metres."""

    set_back: float
    gap: tuple[float, float]
    frontage: tuple[float, float]
    depth: tuple[float, float]


FLATS = Plots(set_back=0.0, gap=(0.0, 2.5), frontage=(11.0, 28.0), depth=(11.0, 17.0))  # set back by the style
HOUSES = Plots(set_back=5.5, gap=(3.0, 8.0), frontage=(9.0, 14.0), depth=(8.0, 11.0))


def fill_block(site: Site, block: Polygon) -> None:
    """Ground, buildings, garden borders and trees of one block."""
    style = site.style
    park_share = style.park_share if block.area > 500 else 1.0  # too small to build on
    shares = np.array([style.dense_share, max(1 - style.dense_share - style.park_share, 0.0), park_share])
    kind = str(site.rng.choice(["flats", "houses", "park"], p=shares / shares.sum()))
    _lay_ground(site, block, kind)
    built: list[Polygon] = []
    if kind != "park":
        built = _line_with_buildings(site, block, kind)
    if kind == "houses":
        _border_gardens(site, block)
    _scatter_trees(site, block, kind, built)


def _lay_ground(site: Site, block: Polygon, kind: str) -> None:
    lawn, paving = Surface(Material.GRASS, LAWN), Surface(Material.PLAZA, PAVING)
    above_m = CURB_M - 0.005  # reaches under the sidewalk, so that no gap shows between them
    block = block.buffer(0.05, join_style="mitre")
    if kind != "flats":
        site.terrain.drape(site.builder, polygons(block), lawn, above_m)
        return
    yard = block.buffer(-20)  # behind the buildings
    site.terrain.drape(site.builder, polygons(block.difference(yard)), paving, above_m)
    site.terrain.drape(site.builder, polygons(yard), lawn, above_m)


def _line_with_buildings(site: Site, block: Polygon, kind: str) -> list[Polygon]:
    """Put buildings side by side along the edge of a block; returns their ground plans."""
    plots = FLATS if kind == "flats" else HOUSES
    set_back_m = site.style.set_back_m if kind == "flats" else plots.set_back
    line = block.buffer(-set_back_m, join_style="mitre")
    built: list[Polygon] = []
    for part in polygons(line):
        corners = np.asarray(shapely.geometry.polygon.orient(part).exterior.simplify(0.6).coords)
        for start, end in itertools.pairwise(corners):
            for box in _plots_along(site.rng, plots, start, end):
                plan = Polygon(box.vertices()[:4, :2])
                if line.buffer(0.7).contains(plan) and not any(plan.intersects(other) for other in built):
                    built.append(plan.buffer(0.3))
                    _build(site, box, kind)
    return built


def _plots_along(rng: np.random.Generator, plots: Plots, start: NDArray, end: NDArray) -> list[Box]:
    length_m = float(np.linalg.norm(end - start))
    if length_m < 9:
        return []
    tangent = (end - start) / length_m
    inward = np.array([-tangent[1], tangent[0]])  # the ring runs counter-clockwise
    yaw_rad = float(np.arctan2(tangent[1], tangent[0]))
    boxes, along_m = [], rng.uniform(0, 3)
    while along_m + 9 < length_m:  # narrower plots look like towers of cards
        width = min(rng.uniform(*plots.frontage), length_m - along_m)
        depth = rng.uniform(*plots.depth)
        x, y = start + tangent * (along_m + width / 2) + inward * depth / 2
        boxes.append(Box(x, y, 0.0, width, depth, 1.0, yaw_rad))
        along_m += width + rng.uniform(*plots.gap)
    return boxes


def _build(site: Site, box: Box, kind: str) -> None:
    rng, style = site.rng, site.style
    foot_m = site.terrain.lowest_m(box.vertices()[:4]) + 0.1
    if kind == "houses":
        height_m = 3.0 * int(rng.integers(1, 3)) + 0.4
        _add_block(site, box._replace(z=foot_m, height=height_m), "house", has_shop=False)
    elif rng.random() < style.tower_share:
        base = box._replace(z=foot_m, height=2 * FLOOR_M)
        number = _add_block(site, base, "flats", has_shop=True)
        floors = int(rng.integers(style.tower_floors[0], style.tower_floors[1] + 1))
        shaft = base._replace(z=foot_m + base.height, height=FLOOR_M * floors)
        shaft = shaft._replace(length=0.85 * box.length, width=0.8 * box.width)
        colour = _varied(rng, GLASS)
        add_building(site.builder, rng, Building(shaft, colour, 4 * _window_seed(site), number, "distant"))
    else:
        floors = int(rng.integers(style.floors[0], style.floors[1] + 1))
        _add_block(site, box._replace(z=foot_m, height=FLOOR_M * floors), "flats", has_shop=rng.random() < 0.6)


def _add_block(site: Site, box: Box, kind: BuildingKind, has_shop: bool) -> int:
    """One building in the colours of the city; returns its object number."""
    rng, style = site.rng, site.style
    is_brick = rng.random() < style.brick_share
    palette = [wall for wall in style.walls if (wall in BRICK) == is_brick] or list(style.walls)
    pattern = 4 * _window_seed(site) + 2 * is_brick + has_shop
    building = Building(box, _varied(rng, palette), int(pattern), site.next_instance(), kind)
    add_building(site.builder, rng, building, style.tiles)
    return building.instance


def _varied(rng: np.random.Generator, palette: Sequence[Colour]) -> Colour:
    colour = np.array(palette[int(rng.integers(len(palette)))]) + rng.normal(0, 0.03) + rng.normal(0, 0.01, 3)
    red, green, blue = np.clip(colour, 0.06, 0.85).tolist()
    return red, green, blue


def _window_seed(site: Site) -> int:
    seeds = window_seeds(*site.style.windows)
    return seeds[int(site.rng.integers(len(seeds)))]


def _border_gardens(site: Site, block: Polygon) -> None:
    """Hedges, fences or low walls around a block of houses, with gaps for paths."""
    rng = site.rng
    border = block.buffer(-0.4, join_style="mitre")
    for part in polygons(border):
        corners = np.asarray(part.exterior.simplify(0.3).coords)
        for start, end in itertools.pairwise(corners):
            along_m = 1.0
            length_m = float(np.linalg.norm(end - start))
            yaw_rad = float(np.arctan2(*(end - start)[::-1]))
            while along_m + 4 < length_m:
                panel_m = min(rng.uniform(5, 12), length_m - along_m)
                x, y = start + (end - start) * (along_m + panel_m / 2) / length_m
                panel = Box(x, y, 0.0, panel_m, 0.1, 1.15, yaw_rad)
                _add_panel(site, panel._replace(z=site.terrain.lowest_m(panel.vertices()) + 0.1))
                along_m += panel_m + rng.uniform(1.2, 3)


def _add_panel(site: Site, box: Box) -> None:
    rng, instance = site.rng, site.next_instance()
    if rng.random() < site.style.hedge_share:
        leaf = np.array(site.style.foliage) * rng.uniform(0.6, 0.9)
        hedge = box._replace(width=0.6, height=float(rng.uniform(0.9, 1.6)), taper=0.92)
        site.builder.add(hedge.vertices(), BOX_FACES[2:], Surface(Material.FOLIAGE, leaf, instance))
        return
    if rng.random() < 0.45:
        stone = tuple(rng.uniform(0.8, 1.1) * np.array([0.42, 0.38, 0.33]))
        wall = box._replace(width=0.28, height=float(rng.uniform(0.7, 1.2)))
        site.builder.add(wall.vertices(), BOX_FACES[2:], Surface(Material.GARDEN_WALL, stone, instance))
        return
    wood = [(0.45, 0.42, 0.38), (0.22, 0.14, 0.08), (0.12, 0.14, 0.13)][int(rng.integers(3))]
    site.builder.add(box.vertices(), BOX_FACES[2:], Surface(Material.FENCE, wood, instance))


def _scatter_trees(site: Site, block: Polygon, kind: str, built: list[Polygon]) -> None:
    inner = block.buffer(-2.5)
    if inner.is_empty:
        return
    area_per_tree = 150 if kind == "park" else 420  # square metres
    low_x, low_y, high_x, high_y = block.bounds
    spots = site.rng.uniform((low_x, low_y), (high_x, high_y), (int(block.area / area_per_tree), 2))
    free = shapely.contains_xy(inner, spots[:, 0], spots[:, 1])
    if built:
        free &= ~shapely.contains_xy(shapely.union_all(built).buffer(2.2), spots[:, 0], spots[:, 1])
    site.trees.extend(spots[free])
