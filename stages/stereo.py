"""How far the surfaces in a tile's images are, from neighbouring images alone, before anything is trained.

Each image is compared with the twelve of its drive that show most of the same (`plane_sweep`). Depths stay where
another image, looked at for itself, says the same of the place: nine in ten of those are right
(docs/benchmarks/field.md). The field is then told to end its rays there.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float16, UInt8
from numpy.typing import NDArray
from torch import Tensor

from presight_core import classes
from presight_core.cameras import Camera, pixel_centres
from presight_core.drives import FrameTable
from presight_core.field.rays import Rays
from presight_core.images import grey_level, resized
from presight_core.patch_scores import View
from presight_core.pixels import PixelSource, cell_of
from presight_core.plane_sweep import CELL_PX, MIDDLE_PX, Cells, grid_shape, sweep
from presight_core.progress import Progress, Report, silent
from stages.neighbours import Neighbours

LEVEL = classes.lookup(("road", "sidewalk", "terrain"))  # patches of these lie flat, others face the camera at first
NOWHERE = classes.lookup((*classes.DYNAMIC, "sky"))  # no ray of training wants to know where these are
SLIM = classes.lookup(("pole", "traffic light", "traffic sign"))  # narrower than a cell, which may show what is behind
SOURCES = 12  # images that an image is compared with
JUDGES = 20  # images that are asked whether they found the same
AGREEING = 1  # of the judges must have; with more, or a share of those that see the place, fields find less
MAX_DIFFERENCE = 0.04  # between depths that agree, a share; their mean is more exact than any of them
MIDDLE = MIDDLE_PX / CELL_PX  # of a cell, from its left and upper side
MAX_RATIO = 2.0  # of the nearness of a plane in the cell next to its own
AROUND = tuple(product((-1, 0, 1), repeat=2))  # rows and columns to the cells around, and its own
KEPT_VIEWS = 512  # small images in memory, 50 MB: a drive's neighbours follow each other in time

PlaneMaps = Float16[NDArray, "images rows columns 3"]  # the plane in each cell, as `sweep` tells it


@dataclass(frozen=True)
class Images:
    """Some rows of a frame table, and what gives their pixels."""

    frames: FrameTable  # the whole table, whose rows `source` counts
    rows: NDArray[np.int64]
    source: PixelSource


def plane_maps(images: Images, width_px: int, file: Path, report: Report = silent) -> PlaneMaps:
    """The planes that are known of each image. They are kept in `file`, and taken from there the next time.

    Images are compared at the given width, or at their own if that is less. Raises InputError if an image cannot be
    read.
    """
    if not file.exists():
        comparison = _Comparison(images, small_cameras(images.frames.select(images.rows), width_px))
        guesses, agreed = (_new_array(file.with_suffix(suffix), comparison.shape) for suffix in (".guesses", ".part"))
        for done, image in enumerate(comparison.in_order, 1):
            comparison.guess(image, guesses)
            report(Progress("stereo", done, len(images.rows)))
        for image in comparison.in_order:
            comparison.judge(image, guesses, agreed)
        agreed.flush()
        file.with_suffix(".part").replace(file)
        file.with_suffix(".guesses").unlink()
    return np.load(file, mmap_mode="c")


class KnownDepths:
    """Where rays of trained images end, as far as that is known."""

    def __init__(self, maps: PlaneMaps, frames: FrameTable, width_px: int, device: str) -> None:
        """Maps of `plane_maps`, whose frames are numbered as the field's images."""
        cell_from_pixel = np.diag([1 / CELL_PX, 1 / CELL_PX, 1])
        cell_from_world = [
            cell_from_pixel @ camera.intrinsics @ camera.world_from_camera[:3, :3].T
            for camera in small_cameras(frames, width_px)
        ]
        self._maps = torch.from_numpy(maps).to(device)
        self._cell_from_world = torch.from_numpy(np.array(cell_from_world, np.float32)).to(device)
        self._is_slim = torch.from_numpy(SLIM).to(device)

    def along(self, rays: Rays, labels: UInt8[Tensor, " rays"]) -> Float[Tensor, "rays 2"]:
        """Metres along each ray to where it ends, and to the nearest surface in its cell or those around; 0: unknown.

        Beside an edge a cell shows both sides of it, and its depth is that of one. What is slim ends at the nearest.
        """
        assert rays.images is not None, "rays of training come from images"
        x, y, along_axis = torch.einsum("nij,nj->in", self._cell_from_world[rays.images], rays.directions)
        column, row = x / along_axis, y / along_axis
        around = torch.stack([self._nearness(rays.images, row, column, down, right) for down, right in AROUND])
        nearest = around.amax(0)
        end = torch.where(self._is_slim[labels.long()], nearest, around[AROUND.index((0, 0))])
        nearness = torch.stack([end, nearest], -1) * along_axis[:, None]
        return torch.where(nearness > 0, 1 / nearness, 0)

    def _nearness(self, images: Tensor, row: Tensor, column: Tensor, down: int, right: int) -> Tensor:
        """1 / depth at places, counted in cells, if the plane of a cell some rows down and columns right goes on there.

        0 where it is unknown. Beyond the rim the planes are those of the cells there.
        """
        _, row_count, column_count, _ = self._maps.shape
        i, j = (row.long() + down).clamp(0, row_count - 1), (column.long() + right).clamp(0, column_count - 1)
        nearness, *growth = self._maps[images, i, j].float().unbind(-1)
        there = nearness + (column - j - MIDDLE) * growth[0] + (row - i - MIDDLE) * growth[1]
        return there.clamp(nearness / MAX_RATIO, nearness * MAX_RATIO)


class _Comparison:
    """Images and their neighbours."""

    def __init__(self, images: Images, cameras: list[Camera]) -> None:
        self._images, self._cameras = images, cameras
        chosen = images.frames.select(images.rows)
        self._drive_id = chosen.drive_id
        self._neighbours = Neighbours(chosen)
        self._view = lru_cache(KEPT_VIEWS)(self._load)
        self.in_order = np.lexsort([chosen.timestamp_us, chosen.drive_id]).tolist()
        shapes = [grid_shape(each.width_px, each.height_px) for each in cameras]
        self.shape = len(cameras), *np.max(shapes, 0).tolist(), 3

    def guess(self, image: int, guesses: PlaneMaps) -> None:
        """Write the depths at which other images of the drive, so in the same light, look best."""
        others = self._neighbours.of(image)
        others = others[self._drive_id[others] == self._drive_id[image]][:SOURCES].tolist()
        if others:
            _put(guesses[image], sweep(*self._view(image), [self._view(other)[0] for other in others]))

    def judge(self, image: int, guesses: PlaneMaps, agreed: PlaneMaps) -> None:
        """Write the guesses with which those of other images, of any drive, agree: the mean of all of them."""
        camera = self._cameras[image]
        shape = grid_shape(camera.width_px, camera.height_px)
        planes = guesses[image, : shape[0], : shape[1]].astype(np.float64).reshape(-1, 3)
        known = np.flatnonzero(planes[:, 0])
        origin, directions = camera.rays(pixel_centres(camera.width_px, camera.height_px, CELL_PX)[known])
        points = origin + directions / (planes[known, 0] * (directions @ camera.world_from_camera[:3, 2]))[:, None]
        votes, total = np.zeros((2, len(known)))
        for judge in self._neighbours.of(image)[:JUDGES].tolist():
            difference = _difference(self._cameras[judge], guesses[judge], points)
            agrees = np.abs(difference) < MAX_DIFFERENCE
            votes += agrees
            total += np.where(agrees, difference, 0)
        factor = 1 / (1 + total / (votes + 1))  # its own guess is one, too
        planes[known] *= np.where(votes >= AGREEING, factor, 0)[:, None]
        _put(agreed[image], planes.reshape(*shape, 3))

    def _load(self, image: int) -> tuple[View, Cells]:
        """A small grey image, and what labels tell of its cells."""
        camera, (rgb, seen) = self._cameras[image], self._images.source.load_view(int(self._images.rows[image]))
        size_px = camera.width_px, camera.height_px
        labels = seen[cell_of(pixel_centres(*size_px, CELL_PX), size_px, seen.shape)]
        normals = np.where(LEVEL[labels][:, None], camera.world_from_camera[2, :3], (0.0, 0.0, 1.0))
        normals[NOWHERE[labels]] = 0
        shape = grid_shape(*size_px)
        view = View(grey_level(resized(rgb, *size_px)), camera)
        return view, Cells(normals.reshape(*shape, 3), LEVEL[labels].reshape(shape), labels.reshape(shape))


def small_cameras(frames: FrameTable, width_px: int) -> list[Camera]:
    """The cameras of the frames' images as they are compared."""
    cameras = [frames.camera_of(row) for row in range(len(frames))]
    scales = [min(1.0, width_px / camera.width_px) for camera in cameras]
    return [
        camera.scaled(round(camera.width_px * scale), max(1, round(camera.height_px * scale)))
        for camera, scale in zip(cameras, scales, strict=True)
    ]


def _difference(
    camera: Camera, guess: Float16[NDArray, "rows columns 3"], points_world: NDArray
) -> Float[NDArray, " points"]:
    """How much farther than points (N, 3) in the world a camera's guess puts what is there, a share; NaN outside."""
    pixels, depth_m = camera.project(points_world)
    inside = np.flatnonzero(np.all((pixels >= 0) & (pixels < [camera.width_px, camera.height_px]), axis=-1))
    place = pixels[inside] / CELL_PX
    columns, rows = np.minimum(place, np.array(guess.shape)[1::-1] - 1).astype(np.int64).T
    nearness, right, down = guess[rows, columns].astype(np.float64).T
    there = nearness + (place[:, 0] - columns - MIDDLE) * right + (place[:, 1] - rows - MIDDLE) * down
    difference = np.full(len(points_world), np.nan)
    with np.errstate(divide="ignore"):
        difference[inside] = 1 / (there * depth_m[inside]) - 1
    return difference


def _put(grid: PlaneMaps, planes: NDArray) -> None:
    """Fill the corner of a grid, which may be of a larger image."""
    grid[: planes.shape[0], : planes.shape[1]] = planes


def _new_array(file: Path, shape: tuple[int, ...]) -> np.memmap:
    return np.lib.format.open_memmap(file, "w+", np.float16, shape)
