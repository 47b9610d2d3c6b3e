"""What a stage may ask of an image, wherever its pixels, labels and features are kept."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class FramePixels:
    """One frame's pixels, labels and features. The three grids cover the same image, each at its own resolution."""

    rgb: NDArray[np.uint8]  # (H, W, 3) at the working resolution
    labels: NDArray[np.uint8]  # (h, w) Cityscapes train ids, 255 unknown
    features: NDArray[np.uint8]  # (rows, columns, C) in the shared feature space, 255 = 1.0


@dataclass(frozen=True)
class FrameLayers:
    """What the feature stage adds to one frame: the label map and the features, as in FramePixels."""

    labels: NDArray[np.uint8]  # (h, w)
    features: NDArray[np.uint8]  # (rows, columns, C)


class PixelSource(Protocol):
    """Gives the pixels of the rows of one FrameTable; safe to call from several threads."""

    def load(self, row: int) -> FramePixels:
        """Decode one row. Raises InputError if the image cannot be read."""
        ...

    def load_view(self, row: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Pixels and labels of `load`. A source that keeps features apart need not decode them."""
        pixels = self.load(row)
        return pixels.rgb, pixels.labels


def cell_of(
    pixels: NDArray[np.float64], image_size_px: tuple[int, int], grid: tuple[int, ...]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of the grid cells that hold image pixels (N, 2) of an image of (width, height)."""
    column = pixels[:, 0] * (grid[1] / image_size_px[0])
    row = pixels[:, 1] * (grid[0] / image_size_px[1])
    return np.clip(row.astype(np.int64), 0, grid[0] - 1), np.clip(column.astype(np.int64), 0, grid[1] - 1)
