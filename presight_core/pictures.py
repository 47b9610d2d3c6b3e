"""Pictures for people: depths, labels, features and rows of images, as uint8 RGB arrays (H, W, 3).

Maps of tiles and bird's-eye views are in `presight_core.maps`. Pillow and matplotlib are imported when a
picture is drawn, so that importing this module costs nothing.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from presight_core import classes

Rgb: TypeAlias = NDArray[np.uint8]  # (H, W, 3)

NEAREST_DEPTH_M, FARTHEST_DEPTH_M = 1.0, 80.0  # bonnet to the end of a street; beyond, colours saturate
UNKNOWN_COLOUR = (0, 0, 0)
GAP_PX = 4  # white between the images of a row: enough to see where one ends
TITLE_PX = 22  # height of the strip that holds a title
FONT_PX = 15  # fits TITLE_PX with its descenders
WHITE = 255


def depth_image(depth_m: ArrayLike) -> Rgb:
    """Depths (H, W), metres, in turbo on a logarithmic scale from 1 m (red) to 80 m (blue).

    Pixels without a depth (0 or less, NaN, infinite: the sky) are black.
    """
    from matplotlib import colormaps

    depth = np.asarray(depth_m, np.float64)
    known = np.isfinite(depth) & (depth > 0)
    clipped = np.clip(np.where(known, depth, FARTHEST_DEPTH_M), NEAREST_DEPTH_M, FARTHEST_DEPTH_M)
    share = np.log(clipped / NEAREST_DEPTH_M) / np.log(FARTHEST_DEPTH_M / NEAREST_DEPTH_M)
    rgb = colormaps["turbo"](1 - share, bytes=True)[..., :3]
    return np.where(known[..., None], rgb, 0).astype(np.uint8)


def label_image(labels: ArrayLike) -> Rgb:
    """Cityscapes train ids (H, W) in the customary colours; ids outside 0..18 are black."""
    table = np.full((256, 3), UNKNOWN_COLOUR, np.uint8)
    table[: len(classes.COLOURS)] = classes.COLOURS
    return table[np.asarray(labels, np.uint8)]


def feature_image(features: ArrayLike) -> Rgb:
    """The first three channels of features (H, W, C) as red, green and blue; the last one repeats where C < 3.

    uint8 features are taken as they are, floating-point ones as 0..1. The feature space is ordered by
    variance, so these are its three strongest directions, and equal features have equal colours in all pictures.
    """
    features = np.asarray(features)
    first = features[..., np.minimum([0, 1, 2], features.shape[-1] - 1)]
    if first.dtype == np.uint8:
        return first
    return np.round(np.clip(np.nan_to_num(first), 0, 1) * 255).astype(np.uint8)


def overlay(rgb: Rgb, mask: ArrayLike, colour: tuple[int, int, int] = (255, 0, 0), opacity: float = 0.5) -> Rgb:
    """The image with the pixels of a mask (h, w), of any resolution, tinted."""
    height, width = rgb.shape[:2]
    mask = np.asarray(mask, np.bool_)
    rows = np.arange(height) * mask.shape[0] // height
    columns = np.arange(width) * mask.shape[1] // width
    tinted = np.round(rgb * (1 - opacity) + np.array(colour) * opacity).astype(np.uint8)
    return np.where(mask[rows][:, columns, None], tinted, rgb)


def stack_rows(
    rows: Sequence[Sequence[ArrayLike]], column_titles: Sequence[str] = (), height_px: int | None = None
) -> Rgb:
    """One picture of rows of images, each row brought to one height: `height_px`, or that of its tallest image.

    Grey images (H, W) are accepted. Small grids such as feature maps grow without blur.
    """
    scaled = [_row_of_equal_height(row, height_px) for row in rows]
    columns = max(len(row) for row in scaled)
    widths = [max(row[i].shape[1] for row in scaled if i < len(row)) for i in range(columns)]
    strips = [_join([_padded(image, width) for image, width in zip(row, widths, strict=False)], 1) for row in scaled]
    total_width = max(strip.shape[1] for strip in strips)
    if column_titles:
        titles = [title_strip(title, width) for title, width in zip(column_titles, widths, strict=True)]
        strips.insert(0, _join(titles, 1))
    return _join([_padded(strip, total_width) for strip in strips], 0)


def title_strip(title: str, width_px: int) -> Rgb:
    """A white strip of the given width with a line of text."""
    from PIL import Image, ImageDraw

    strip = Image.new("RGB", (width_px, TITLE_PX), "white")
    ImageDraw.Draw(strip).text((2, 1), title, fill="black", font=font())
    return np.asarray(strip)


def font() -> Any:
    """The font of all pictures: the one that comes with Pillow."""
    from PIL import ImageFont

    return ImageFont.load_default(FONT_PX)


def resize(rgb: ArrayLike, width_px: int, height_px: int) -> Rgb:
    """The image at another size: averaged when it shrinks, nearest pixel when it grows."""
    from PIL import Image

    image = np.asarray(rgb, np.uint8)
    method = Image.Resampling.BOX if height_px < image.shape[0] else Image.Resampling.NEAREST
    return np.asarray(Image.fromarray(image).resize((width_px, height_px), method))


def save_png(path: Path | str, rgb: ArrayLike) -> None:
    """Write an image (H, W, 3) or (H, W) to `path`, whole or not at all; its folder is made."""
    from PIL import Image

    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.tmp")
    Image.fromarray(np.asarray(rgb, np.uint8)).save(temporary, format="PNG")
    temporary.replace(path)


def _row_of_equal_height(row: Sequence[ArrayLike], height_px: int | None) -> list[Rgb]:
    images = [np.asarray(image, np.uint8) for image in row]
    images = [np.repeat(image[..., None], 3, -1) if image.ndim == 2 else image for image in images]
    height = height_px or max(image.shape[0] for image in images)
    return [resize(image, max(1, round(image.shape[1] * height / image.shape[0])), height) for image in images]


def _padded(image: Rgb, width_px: int) -> Rgb:
    missing = width_px - image.shape[1]
    return np.pad(image, ((0, 0), (0, missing), (0, 0)), constant_values=WHITE)


def _join(images: Sequence[Rgb], axis: int) -> Rgb:
    """Images side by side (axis 1) or one above the other (axis 0), with a white gap."""
    gap_shape = list(images[0].shape)
    gap_shape[axis] = GAP_PX
    gap = np.full(gap_shape, WHITE, np.uint8)
    parts = [part for image in images for part in (image, gap)]
    return np.concatenate(parts[:-1], axis)
