"""Rays for training and evaluation: pixels of many images, kept in memory for quick random access."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from presight_core import classes
from presight_core.drives import FrameTable
from presight_core.errors import InputError
from presight_core.field.lens import off_centre
from presight_core.pixels import FramePixels, PixelSource

THIN = ("pole", "traffic light", "traffic sign", "fence")  # a few pixels wide: even draws hardly ever meet them
AHEAD = 4  # images a thread that may wait, decoded, to be copied
DRAW_ROUNDS = 100  # of a batch each; images nine tenths of which are masked still fill a batch long before


@dataclass(frozen=True)
class PixelBatch:
    """Rays through pixels, and what the images show there."""

    rows: NDArray[np.int64]  # (R,) of the frame table
    origins_world: NDArray[np.float64]  # (R, 3) metres
    directions_world: NDArray[np.float64]  # (R, 3) unit length
    off_centre: NDArray[np.float64]  # (R,) of the pixels; see `field.lens`
    rgb: NDArray[np.uint8]  # (R, 3)
    labels: NDArray[np.uint8]  # (R,) Cityscapes train ids, 255 unknown
    features: NDArray[np.uint8]  # (R, C), 255 = 1.0

    def select(self, mask: NDArray[np.bool_]) -> "PixelBatch":
        """The rays of the mask."""
        return PixelBatch(*(getattr(self, column.name)[mask] for column in fields(self)))

    @staticmethod
    def concatenate(batches: Sequence["PixelBatch"]) -> "PixelBatch":
        """One batch of all rays, in the given order; at least one batch."""
        columns = (column.name for column in fields(PixelBatch))
        return PixelBatch(*(np.concatenate([getattr(batch, name) for batch in batches]) for name in columns))


class RayPool:
    """The decoded images of some rows of a frame table.

    The grids of all images lie behind one another in one array a kind, so that pixels of any images are
    fetched by one indexing.
    """

    def __init__(self, frames: FrameTable, source: PixelSource, rows: NDArray[np.int64], threads: int = 1) -> None:
        """Decode the rows. Raises InputError if an image cannot be read."""
        self.rows = np.asarray(rows, np.int64)
        selected = frames.select(self.rows)
        self._positions = selected.positions
        rotations = selected.world_from_camera[:, :3, :3]
        self._world_from_pixel = rotations @ np.linalg.inv(selected.intrinsics)  # directions, not yet of unit length
        self._sizes_px = np.stack([selected.width_px, selected.height_px], -1).astype(np.float64)
        self._rgb, self._labels, self._features = (_Grids(len(self.rows)) for _ in range(3))
        with ThreadPoolExecutor(threads) as executor:
            for first in range(0, len(self.rows), AHEAD * threads):  # so that few images wait to be copied
                for image in executor.map(source.load, self.rows[first : first + AHEAD * threads].tolist()):
                    self._rgb.append(image.rgb)
                    self._labels.append(image.labels)
                    self._features.append(image.features)

    @property
    def nbytes(self) -> int:
        """Memory of the decoded images."""
        return sum(grids.nbytes for grids in (self._rgb, self._labels, self._features))

    def draw(self, count: int, groups: Sequence[NDArray[np.int64]], random: np.random.Generator) -> PixelBatch:
        """Pixels at random: a group uniformly, an image (by its place in `rows`) of it, then a pixel of that."""
        return self.at(*self.pick(count, groups, random))

    def pick(
        self, count: int, groups: Sequence[NDArray[np.int64]], random: np.random.Generator
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Images (count,) and pixels (count, 2) as `draw` chooses them, for `at`."""
        chosen = random.integers(len(groups), size=count)
        sizes = np.array([len(group) for group in groups])
        starts = np.cumsum(sizes) - sizes
        within = (random.random(count) * sizes[chosen]).astype(np.int64)
        images = np.concatenate(groups)[starts[chosen] + within]
        shape = self._rgb.shapes[images]
        return images, (random.random((count, 2)) * shape[:, ::-1]).astype(np.int64)

    def labels_at(self, images: NDArray[np.int64], pixels: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Only the labels of `at`."""
        return self._labels.at(images, (pixels + 0.5) / self._rgb.shapes[images][:, ::-1])

    def at(self, images: NDArray[np.int64], pixels: NDArray[np.int64]) -> PixelBatch:
        """Pixels (R, 2), column and row at the working resolution, of images by their place in `rows`."""
        unit = (pixels + 0.5) / self._rgb.shapes[images][:, ::-1]
        full = np.concatenate([unit * self._sizes_px[images], np.ones((len(images), 1))], -1)
        directions = np.einsum("nij,nj->ni", self._world_from_pixel[images], full)
        return PixelBatch(
            self.rows[images],
            self._positions[images],
            directions / np.linalg.norm(directions, axis=-1, keepdims=True),
            off_centre(unit, self._sizes_px[images]),
            self._rgb.at(images, unit),
            self._labels.at(images, unit),
            self._features.at(images, unit),
        )

    def size_px(self, image: int) -> tuple[int, int]:
        """Width and height of an image at the working resolution."""
        height, width = self._rgb.shapes[image]
        return int(width), int(height)


def draw_static(
    pool: RayPool,
    count: int,
    groups: Sequence[NDArray[np.int64]],
    random: np.random.Generator,
    dynamic_classes: tuple[str, ...],
    thin_weight: float = 1.0,
) -> PixelBatch:
    """`count` random pixels that show nothing of the given classes; those of THIN classes `thin_weight` times likelier.

    Raises InputError if the images show hardly anything else.
    """
    share = np.where(classes.lookup(THIN), 1.0, 1 / thin_weight) * ~classes.lookup(dynamic_classes)
    batches, missing = [], count
    for _ in range(DRAW_ROUNDS):
        # A quarter more than the weights ask for: traffic rarely covers more than that.
        images, pixels = pool.pick(int(count * thin_weight * 1.25), groups, random)
        kept = np.flatnonzero(random.random(len(images)) < share[pool.labels_at(images, pixels)])[:missing]
        batches.append(pool.at(images[kept], pixels[kept]))
        missing -= len(kept)
        if not missing:
            return PixelBatch.concatenate(batches)
    raise InputError(
        f"{len(pool.rows)} images show hardly anything but {', '.join(dynamic_classes)}; "
        "check their label maps, or shorten features.dynamic_classes"
    )


def choose_images(sub_fields: NDArray[np.int64], capacity: int, random: np.random.Generator) -> NDArray[np.int64]:
    """At most `capacity` of the images whose sub-fields (N,) are given, ascending; as many of each as there is room."""
    if len(sub_fields) <= capacity:
        return np.arange(len(sub_fields))
    order = random.permutation(len(sub_fields))
    owner = sub_fields[order]
    by_owner = np.argsort(owner, kind="stable")
    rank = np.empty(len(order), np.int64)  # how many of its sub-field come before each
    rank[by_owner] = np.arange(len(order)) - np.searchsorted(owner[by_owner], owner[by_owner])
    return np.sort(order[np.argsort(rank, kind="stable")[:capacity]])


def bytes_of(image: FramePixels) -> int:
    """Memory of one decoded image."""
    return image.rgb.nbytes + image.labels.nbytes + image.features.nbytes


class _Grids:
    """Grids (rows, columns, ...) of many images, flattened behind one another."""

    def __init__(self, image_count: int) -> None:
        self.shapes = np.zeros((image_count, 2), np.int64)
        self._starts = np.zeros(image_count, np.int64)
        self._values = np.zeros(0, np.uint8)
        self._images = self._filled = 0

    @property
    def nbytes(self) -> int:
        """Memory of the grids."""
        return self._values[: self._filled].nbytes

    def append(self, grid: NDArray[np.uint8]) -> None:
        """Copy the next image's grid."""
        flat = grid.reshape(-1, *grid.shape[2:])
        if not self._images:  # pages that are never written take no memory
            self._values = np.empty((len(flat) * len(self.shapes), *flat.shape[1:]), np.uint8)
        elif self._filled + len(flat) > len(self._values):  # later images are larger than the first
            room = np.empty((max(len(flat), len(self._values) // 4), *flat.shape[1:]), np.uint8)
            self._values = np.concatenate([self._values, room])
        self._values[self._filled : self._filled + len(flat)] = flat
        self.shapes[self._images], self._starts[self._images] = grid.shape[:2], self._filled
        self._images, self._filled = self._images + 1, self._filled + len(flat)

    def at(self, images: NDArray[np.int64], unit: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Values (R, ...) of the cells that hold places (R, 2), x and y in 0..1 of the image."""
        rows, columns = (unit[:, ::-1] * self.shapes[images]).astype(np.int64).T
        # take moves whole cells: a quarter off the time of a draw
        return self._values.take(self._starts[images] + rows * self.shapes[images, 1] + columns, 0)
