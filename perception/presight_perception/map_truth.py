"""Map ground truth from nuScenes map-expansion JSON (format 1.3): lines around a vehicle, and the same as pictures.

Lines are in the vehicle's frame with the heading only (no roll or pitch), in metres, x forward and y left.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from shapely import LineString, Polygon, STRtree
from shapely.geometry.base import BaseGeometry
from shapely.geometry.polygon import orient

from presight_core.errors import InputError, NotFoundError

MAP_CLASSES = ("ped_crossing", "divider", "boundary")  # in the order of StreamMapNet's labels

MapLines = dict[str, list[NDArray[np.float64]]]  # class -> polylines (V, 2), ego metres


@dataclass(frozen=True)
class MapTruthSettings:
    """How the map is cut out around the vehicle."""

    length_m: float = 100.0  # along the heading, half of it behind
    width_m: float = 50.0
    simplify_m: float = 0.2  # lines may lose vertices that move them less; as the released evaluator does
    border_m: float = 0.2  # boundaries end so far from the range's edge, lest the edge become one
    parallel: float = 0.01  # crossings are one if 1 - |cosine| of their directions is less, and their boxes touch


@dataclass(frozen=True)
class RasterSettings:
    """A picture of the range: rows from the right (least y) to the left, columns from back to front."""

    height_px: int = 200
    width_px: int = 400
    thickness_px: int = 5  # as released: OpenCV paints 7 rows, 1.75 m; 1 paints one, and no constant mask does well


class VectorMap:
    """A city's crossings, dividers and road surfaces, each findable by place."""

    def __init__(self, crossings: list[BaseGeometry], dividers: list[LineString], roads: list[BaseGeometry]) -> None:
        self._crossings = _Places(crossings)
        self._dividers = _Places(dividers)
        self._roads = _Places(roads)

    @staticmethod
    def read(file: Path) -> "VectorMap":
        """The map in a file such as expansion/boston-seaport.json.

        Raises NotFoundError if it is absent, InputError if it is no map-expansion file.
        """
        if not file.is_file():
            raise NotFoundError(f"{file} does not exist; unpack nuScenes' map expansion there")
        try:
            return VectorMap.from_tables(json.loads(file.read_text()))
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{file} is not a map expansion of format 1.3 ({error!r}); download it again") from error

    @staticmethod
    def from_tables(tables: Mapping[str, Any]) -> "VectorMap":
        """The map in parsed tables. Raises KeyError for a table or token that is not there."""
        nodes = {node["token"]: (node["x"], node["y"]) for node in tables["node"]}
        lines = {line["token"]: line["node_tokens"] for line in tables["line"]}
        polygons = {polygon["token"]: polygon for polygon in tables["polygon"]}

        def surfaces(layer: str) -> list[BaseGeometry]:
            return [_surface(polygons[record["polygon_token"]], nodes) for record in tables[layer]]

        dividers = [
            LineString([nodes[token] for token in lines[record["line_token"]]])
            for layer in ("lane_divider", "road_divider")
            for record in tables[layer]
            if len(lines[record["line_token"]]) > 1  # the published maps have records without a line
        ]
        return VectorMap(surfaces("ped_crossing"), dividers, surfaces("road_segment") + surfaces("lane"))

    def lines(self, world_from_ego: ArrayLike, settings: MapTruthSettings | None = None) -> MapLines:
        """Dividers, crossings (closed) and boundaries in the range around a vehicle, by class."""
        settings = settings or MapTruthSettings()
        frame = _Frame.at(np.asarray(world_from_ego, np.float64), settings)
        crossings, dividers, roads = (places.near(frame) for places in (self._crossings, self._dividers, self._roads))
        found = {
            "ped_crossing": _crossing_outlines(crossings, frame, settings.parallel),
            "divider": _lines_of(line.intersection(frame.box) for line in dividers),
            "boundary": _boundaries(roads, frame.box.buffer(-settings.border_m, join_style="mitre")),
        }
        return {
            name: [shapely.get_coordinates(line.simplify(settings.simplify_m)) for line in found[name]]
            for name in MAP_CLASSES
        }


def rasterise(lines: MapLines, truth: MapTruthSettings, raster: RasterSettings) -> NDArray[np.uint8]:
    """Masks (classes, height, width) of 0 and 1 with the lines drawn in; crossings as outlines.

    Pixels are truncated toward zero, as released.
    """
    scale = np.array([raster.width_px / truth.length_m, raster.height_px / truth.width_m])
    centre = np.array([raster.width_px / 2, raster.height_px / 2])
    masks = np.zeros((len(MAP_CLASSES), raster.height_px, raster.width_px), np.uint8)
    for mask, name in zip(masks, MAP_CLASSES, strict=True):
        pixels = [(line * scale + centre).astype(np.int32) for line in lines[name]]
        cv2.polylines(mask, pixels, isClosed=False, color=1, thickness=raster.thickness_px)
    return masks


@dataclass(frozen=True)
class _Frame:
    """A rectangle around a vehicle."""

    x_m: float
    y_m: float
    yaw_rad: float
    box: Polygon  # the range, ego metres

    @staticmethod
    def at(world_from_ego: NDArray[np.float64], settings: MapTruthSettings) -> "_Frame":
        x, y = world_from_ego[:2, 3]
        length, width = settings.length_m / 2, settings.width_m / 2
        yaw = np.arctan2(world_from_ego[1, 0], world_from_ego[0, 0])
        return _Frame(float(x), float(y), float(yaw), shapely.box(-length, -width, length, width))

    @property
    def box_world(self) -> Polygon:
        cosine, sine = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        world_from_ego = np.array([[cosine, -sine], [sine, cosine]])
        return shapely.transform(self.box, lambda xy: xy @ world_from_ego.T + [self.x_m, self.y_m])

    def to_ego(self, geometries: NDArray[Any]) -> list[Any]:
        cosine, sine = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        ego_from_world = np.array([[cosine, sine], [-sine, cosine]])
        return list(shapely.transform(geometries, lambda xy: (xy - [self.x_m, self.y_m]) @ ego_from_world.T))


class _Places:
    """Geometries in the world, found by place."""

    def __init__(self, geometries: Sequence[BaseGeometry]) -> None:
        self._tree = STRtree(geometries)

    def near(self, frame: _Frame) -> list[Any]:
        """Those that meet the frame's range, in ego metres, in the order of the file."""
        rows = np.sort(self._tree.query(frame.box_world, predicate="intersects"))
        return frame.to_ego(self._tree.geometries[rows])


def _surface(polygon: Mapping[str, Any], nodes: Mapping[str, tuple[float, float]]) -> BaseGeometry:
    exterior = [nodes[token] for token in polygon["exterior_node_tokens"]]
    holes = [[nodes[token] for token in hole["node_tokens"]] for hole in polygon["holes"]]
    surface = Polygon(exterior, [hole for hole in holes if len(hole) > 2])
    return surface if surface.is_valid else shapely.make_valid(surface, method="structure")


def _crossing_outlines(crossings: list[Polygon], frame: _Frame, parallel: float) -> list[LineString]:
    """Closed outlines of the crossings in the range; those cut in two by the map's authors are made one again."""
    merged = [shapely.union_all([crossings[row] for row in group]) for group in _merged_groups(crossings, parallel)]
    return [
        LineString(polygon.exterior.coords)
        for crossing in merged
        for polygon in _polygons_of(crossing.intersection(frame.box))
    ]


def _merged_groups(crossings: list[Polygon], parallel: float) -> list[list[int]]:
    """Rows of the crossings that belong together: parallel ones with touching boxes, over any number of steps."""
    directions = np.array([_direction(crossing) for crossing in crossings]).reshape(-1, 2)
    alike = 1 - np.abs(directions @ directions.T) < parallel
    group = np.arange(len(crossings))
    for a, b in STRtree(crossings).query(np.array(crossings, np.object_)).T:
        if alike[a, b]:
            group[group == group[b]] = group[a]
    return [np.flatnonzero(group == number).tolist() for number in np.unique(group)]


def _direction(crossing: Polygon) -> NDArray[np.float64]:
    """Unit vector (2,) along the longer side of the least rectangle around a crossing."""
    corners = shapely.get_coordinates(crossing.minimum_rotated_rectangle)
    sides = corners[1:3] - corners[:2]
    longest = sides[np.linalg.norm(sides, axis=1).argmax()]
    return longest / max(np.linalg.norm(longest), 1e-9)


def _boundaries(roads: list[Polygon], box: Polygon) -> list[LineString]:
    """The edges of the road surface in the box: outer ones clockwise, those of islands counter-clockwise."""
    surfaces = [orient(polygon, sign=-1.0) for polygon in _polygons_of(shapely.union_all(roads))]
    rings = [ring for surface in surfaces for ring in (surface.exterior, *surface.interiors)]
    # A ring's first vertex cuts its line in two where it lies in the box; merging mends that.
    return _lines_of(shapely.line_merge(LineString(ring).intersection(box), directed=True) for ring in rings)


def _polygons_of(geometry: BaseGeometry) -> list[Polygon]:
    parts = [geometry] if isinstance(geometry, Polygon) else getattr(geometry, "geoms", [])
    return [part for part in parts if isinstance(part, Polygon) and not part.is_empty]


def _lines_of(geometries: Iterable[BaseGeometry]) -> list[LineString]:
    """The line parts of geometries; points, where something only touches the edge, are dropped."""
    parts = (part for geometry in geometries for part in getattr(geometry, "geoms", [geometry]))
    return [part for part in parts if isinstance(part, LineString) and not part.is_empty]
