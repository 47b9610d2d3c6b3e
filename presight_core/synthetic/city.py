"""The procedural city: a street graph, its vector layers, and one static triangle mesh.

World metres, x east, y north, z up; the origin is the map's south-west corner, as in nuScenes.
"""

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from presight_core.synthetic.blocks import Site, fill_block
from presight_core.synthetic.buildings import Building, add_building
from presight_core.synthetic.furniture import furnish_streets
from presight_core.synthetic.graph import StreetGraph
from presight_core.synthetic.ground import CURB_M, Terrain
from presight_core.synthetic.layers import StreetLayers, lay_streets, polygons
from presight_core.synthetic.materials import Material
from presight_core.synthetic.mesh import Box, Mesh, MeshBuilder, Surface
from presight_core.synthetic.style import CityStyle
from presight_core.synthetic.vegetation import plant_trees

CHUNK_M = 40.0  # culling unit: a few thousand faces in built-up ground
HORIZON_M = 1200.0  # the plain around the map reaches this far


class City:
    """Everything that stands still in one city; two cities of equal seed and style are bit-identical."""

    graph: StreetGraph
    layers: StreetLayers
    terrain: Terrain
    mesh: Mesh
    lamps: NDArray[np.float64]  # (L, 3) light heads of the street lamps

    def __init__(self, seed: int = 0, style: CityStyle | None = None):
        self.seed = seed
        self.style = style or CityStyle()
        rng = np.random.default_rng(seed)
        style = self.style
        self.graph = StreetGraph(rng, style)
        self.layers = lay_streets(self.graph, style)
        shapely.prepare(self.layers.road)
        self.terrain = Terrain(seed, style.relief_m)
        site = Site(MeshBuilder(), rng, style, self.terrain)
        _lay_surfaces(site, self.layers)
        for block in self.layers.blocks:
            fill_block(site, block)
        furnish_streets(site, self.graph)
        plant_trees(site)
        _raise_skyline(site)
        self.mesh = site.builder.build(CHUNK_M)
        self.lamps = np.array(site.lamps).reshape(-1, 3)

    def height_m(self, x_m: float, y_m: float) -> float:
        """Height of the road surface at a place."""
        return float(self.terrain.height_m(x_m, y_m))

    def surface_m(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Height of what one stands on at places (...,): the road, or a curb higher, all else."""
        is_road = shapely.contains_xy(self.layers.road, np.asarray(x_m, np.float64), np.asarray(y_m, np.float64))
        return self.terrain.height_m(x_m, y_m) + np.where(is_road, 0.0, CURB_M)


def _lay_surfaces(site: Site, layers: StreetLayers) -> None:
    builder, terrain, size_m = site.builder, site.terrain, site.style.size_m
    terrain.drape(builder, layers.drivable, Surface(Material.ASPHALT, site.style.asphalt), 0.0)
    terrain.drape(builder, layers.walkway, Surface(Material.PAVING, site.style.paving), CURB_M)
    paint_m = 0.012  # above the asphalt; the waves cannot swallow it
    terrain.drape(builder, layers.white_paint, Surface(Material.WHITE_PAINT, (0.72, 0.72, 0.70)), paint_m)
    terrain.drape(builder, layers.yellow_paint, Surface(Material.YELLOW_PAINT, (0.74, 0.50, 0.08)), paint_m)
    for polygon in layers.drivable:
        for ring in (polygon.exterior, *polygon.interiors):
            _add_curb(site, np.asarray(shapely.segmentize(ring, terrain.cell_m).coords))
    underlay = Surface(Material.FAR_GROUND, (0.25, 0.25, 0.22))
    square = shapely.box(0, 0, size_m, size_m)
    terrain.drape(builder, [square], underlay, -0.1)  # shows where two layers do not quite meet
    far = shapely.box(-HORIZON_M, -HORIZON_M, size_m + HORIZON_M, size_m + HORIZON_M)
    plain = far.difference(square)
    coarse_m = 300.0  # nobody drives there
    terrain.drape(builder, polygons(plain), Surface(Material.FAR_GROUND, (0.24, 0.28, 0.16)), 0.1, coarse_m)


def _add_curb(site: Site, ring: NDArray[np.float64]) -> None:
    """The curb's face along the edge of the road."""
    ground_m = site.terrain.height_m(ring[:, 0], ring[:, 1])
    count = len(ring)
    vertices = np.r_[np.c_[ring, ground_m - 0.05], np.c_[ring, ground_m + CURB_M + 0.005]]
    i = np.arange(count - 1)
    faces = np.r_[np.c_[i, i + 1, i + 1 + count], np.c_[i, i + 1 + count, i + count]]
    site.builder.add(vertices, faces, Surface(Material.CURB, (0.50, 0.49, 0.47)))


def _raise_skyline(site: Site) -> None:
    """Blocks beyond the map, so that streets do not end in a desert."""
    rng, size_m = site.rng, site.style.size_m
    for _ in range(90):
        angle, distance = rng.uniform(0, 2 * np.pi), size_m * 0.75 + rng.uniform(60, 700)
        x, y = size_m / 2 + distance * np.cos(angle), size_m / 2 + distance * np.sin(angle)
        length, width = rng.uniform(22, 60, 2)
        height = rng.uniform(12, 40) + 0.06 * distance * rng.random()
        box = Box(x, y, -site.style.relief_m, length, width, height, rng.uniform(0, np.pi))
        wall = site.style.walls[int(rng.integers(len(site.style.walls)))]
        building = Building(box, wall, 4 * int(rng.integers(1000)), site.next_instance(), "distant")
        add_building(site.builder, rng, building)
