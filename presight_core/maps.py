"""Maps for people: a city's tiles, and priors seen from above. Pillow and matplotlib are imported when drawing."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from presight_core.pictures import Rgb, feature_image, font, stack_rows
from presight_core.tiles import SubField, Tiling

if TYPE_CHECKING:
    from presight_core.priors.window import Window

Range = tuple[float, float]

BACKGROUND = 235  # light grey: neither white facades nor black asphalt vanish on it
PANEL_PX = 640  # longer side of a bird's-eye panel: three of them fit a wide screen
LEGEND_PX = 24  # strip below a bird's-eye panel for scale and north
NORTH_RADIUS_PX = 9
STEPS_M = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)  # lengths of a scale bar that people can read
FOOTPRINT = 1.5  # voxels: a voxel is drawn at its surface's mean, anywhere inside it, and must not leave holes
CONTRAST = (2, 98)  # percentiles that become the darkest and the brightest: strays would wash the rest out
TILE_MAP_INCHES = 9.0  # longer side
SLIMMEST = 0.4  # shorter side of a tile map, of the longer one: a straight street still needs room for its labels
TILE_MAP_DPI = 110
TINT_CELLS = 400  # resolution of the coloured tile cells behind the positions
MOST_POINTS = 50_000  # more camera positions than this draw slowly and show nothing new


@dataclass(frozen=True)
class MapView:
    """Which rectangle of a plane is drawn, x to the right and y up; `north` points north in that plane."""

    x_m: Range
    y_m: Range
    pixel_m: float
    north: tuple[float, float] = (0.0, 1.0)

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the picture."""
        spans = (self.x_m[1] - self.x_m[0], self.y_m[1] - self.y_m[0])
        width, height = (max(1, round(span / self.pixel_m)) for span in spans)
        return width, height


def birds_eye(points: ArrayLike, colours: ArrayLike, view: MapView, point_m: float) -> Rgb:
    """Points (N, 3) from above in colours (N, 3), squares of `point_m` metres; the highest of a place is seen.

    The plane's y axis points up in the picture. A strip below carries a scale bar and an arrow to the north.
    """
    order = np.asarray(points, np.float64)[:, 2].argsort(kind="stable")
    points, colours = np.asarray(points, np.float64)[order], np.asarray(colours, np.uint8)[order]
    width, height = view.size_px
    column, row = _footprints(points, view, point_m)
    rank = np.broadcast_to(np.arange(len(points))[:, None], column.shape)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    highest = np.full(height * width, -1)
    np.maximum.at(highest, row[inside] * width + column[inside], rank[inside])
    picture = np.full((height * width, 3), BACKGROUND, np.uint8)
    picture[highest >= 0] = colours[highest[highest >= 0]]
    return np.concatenate([picture.reshape(height, width, 3), _legend(view)])


def prior_picture(window: "Window", x_m: Range, y_m: Range, voxel_m: float) -> Rgb:
    """A window of a prior from above, x_m to the right and y_m up (ego metres): colour, features and height."""
    finest = voxel_m / 2  # finer pixels than half a voxel show nothing new
    pixel_m = max(finest, (x_m[1] - x_m[0]) / PANEL_PX, (y_m[1] - y_m[0]) / PANEL_PX)
    view = MapView(x_m, y_m, pixel_m, _north(window.points_ego, window.points_world))
    low, high = _contrast_range(window.points_ego[:, 2:])
    panels = {
        "colour": window.rgb,
        "features, first three channels": feature_image(_stretched(window.features[:, :3])),
        f"height, {low[0]:.1f} m (blue) to {high[0]:.1f} m (red)": height_colours(window.points_ego[:, 2:]),
    }
    drawn = [birds_eye(window.points_ego, colours, view, FOOTPRINT * voxel_m) for colours in panels.values()]
    return stack_rows([drawn], list(panels))


def tile_map(positions_world: ArrayLike, tiling: Tiling, sub_fields: Sequence[Sequence[SubField]] = ()) -> Rgb:
    """Camera positions (N, 3) coloured by tile over the tiles' cells, with the boxes of each tile's sub-fields."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    positions = np.asarray(positions_world, np.float64)[:, :2]
    positions = positions[:: -(-len(positions) // MOST_POINTS)]
    spans = np.maximum(np.ptp(np.concatenate([positions, tiling.centroids]), axis=0), 1.0)
    figure = Figure(TILE_MAP_INCHES * np.maximum(spans / spans.max(), SLIMMEST), TILE_MAP_DPI, layout="constrained")
    axes = figure.add_subplot(aspect="equal", xlabel="x, m east", ylabel="y, m north", title=tiling.city)
    _draw_boxes(axes, sub_fields)
    axes.scatter(*positions.T, s=3, c=_tile_colours(tiling.nearest(positions)), linewidths=0)
    axes.scatter(*tiling.centroids.T, s=60, c="black", marker="+")
    for tile in tiling.tiles:
        axes.annotate(tile.tile_id, tile.centroid_m, (4, 4), textcoords="offset points", weight="bold")
    _draw_cells(axes, tiling)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _footprints(points: NDArray[np.float64], view: MapView, point_m: float) -> tuple[NDArray, NDArray]:
    """Columns and rows (N, K) of the K pixels that each point covers."""
    side = max(1, round(point_m / view.pixel_m))
    across, down = (axis.ravel() for axis in np.meshgrid(np.arange(side), np.arange(side)))
    reach_m = (side - 1) / 2 * view.pixel_m
    left = np.floor((points[:, 0] - reach_m - view.x_m[0]) / view.pixel_m).astype(np.int64)
    top = np.floor((view.y_m[1] - points[:, 1] - reach_m) / view.pixel_m).astype(np.int64)
    return left[:, None] + across, top[:, None] + down


def _legend(view: MapView) -> Rgb:
    """The strip below a bird's-eye panel: a scale bar, and an arrow to the north at the right."""
    from PIL import Image, ImageDraw

    width = view.size_px[0]
    strip = Image.new("RGB", (width, LEGEND_PX), "white")
    draw = ImageDraw.Draw(strip)
    quarter_m = width * view.pixel_m / 4
    length_m = max((step for step in STEPS_M if step <= quarter_m), default=STEPS_M[0])
    bar_px = length_m / view.pixel_m
    draw.rectangle((6, LEGEND_PX // 2 - 2, 6 + bar_px, LEGEND_PX // 2 + 2), fill="black")
    draw.text((12 + bar_px, 2), f"{length_m} m", fill="black", font=font())
    _draw_north(draw, np.array([width - 2 * NORTH_RADIUS_PX, LEGEND_PX / 2]), view.north)
    return np.asarray(strip)


def _draw_north(draw: Any, centre: NDArray[np.float64], north: tuple[float, float]) -> None:
    ahead = np.array([north[0], -north[1]]) / max(np.hypot(*north), 1e-9) * NORTH_RADIUS_PX  # image y points down
    aside = np.array([-ahead[1], ahead[0]]) / 2
    draw.polygon([tuple(centre + ahead), tuple(centre - ahead + aside), tuple(centre - ahead - aside)], fill="black")
    draw.text((centre[0] - 2.5 * NORTH_RADIUS_PX, 2), "N", fill="black", font=font())


def _north(points_ego: NDArray, points_world: NDArray) -> tuple[float, float]:
    """North in the ego plane, from where the same points (N, 3) lie in both frames."""
    ego = points_ego[:, :2] - points_ego[:, :2].mean(0) if len(points_ego) else np.zeros((0, 2))
    world = points_world[:, :2] - points_world[:, :2].mean(0) if len(points_world) else np.zeros((0, 2))
    along, across = (ego * world).sum(), (ego[:, 0] * world[:, 1] - ego[:, 1] * world[:, 0]).sum()
    yaw = np.arctan2(across, along)
    return float(np.sin(yaw)), float(np.cos(yaw))


def _contrast_range(values: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What becomes dark and bright in each channel (N, C); channels without contrast stay finite."""
    if len(values) == 0:
        return np.zeros(values.shape[1]), np.ones(values.shape[1])
    low, high = np.percentile(values.astype(np.float64), CONTRAST, axis=0)
    return low, np.where(high > low, high, low + 1)


def _stretched(values: NDArray) -> NDArray[np.float64]:
    """Channels (N, C) brought to 0..1, so that small differences can be seen."""
    low, high = _contrast_range(values)
    return np.clip((values - low) / (high - low), 0, 1)


def height_colours(heights_m: NDArray) -> NDArray[np.uint8]:
    """Colours (N, 3) of heights (N, 1): turbo from the lowest (blue) to the highest (red), strays apart."""
    from matplotlib import colormaps

    return colormaps["turbo"](_stretched(heights_m)[:, 0], bytes=True)[:, :3]


def _tile_colours(tiles: NDArray) -> NDArray:
    from matplotlib import colormaps

    return colormaps["tab10"](np.asarray(tiles) % 10)


def _draw_boxes(axes: Any, sub_fields: Sequence[Sequence[SubField]]) -> None:
    from matplotlib.patches import Rectangle

    for tile, fields in enumerate(sub_fields):
        colour = _tile_colours(np.array([tile]))[0]
        for field in fields:
            (left, bottom, _), (right, top, _) = field.box_min_m, field.box_max_m
            axes.add_patch(Rectangle((left, bottom), right - left, top - bottom, fill=False, edgecolor=colour))


def _draw_cells(axes: Any, tiling: Tiling) -> None:
    """Tint the whole map by the nearest tile; drawn last, when the map's limits are known."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    x, y = np.meshgrid(np.linspace(left, right, TINT_CELLS), np.linspace(bottom, top, TINT_CELLS))
    nearest = tiling.nearest(np.stack([x.ravel(), y.ravel()], -1)).reshape(x.shape)
    tint = _tile_colours(nearest) * [1, 1, 1, 0.15]  # pale enough to read the positions
    axes.imshow(tint, extent=(left, right, bottom, top), origin="lower", zorder=0, interpolation="nearest")
