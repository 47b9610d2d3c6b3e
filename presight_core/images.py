"""Reading camera images and label maps, and changing their size. OpenCV is imported when it is needed."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from presight_core import classes
from presight_core.drives import Reject
from presight_core.errors import InputError

JPEG_START = b"\xff\xd8"
MASKS_FOLDER = "segmentation"  # of a data set: precomputed label maps, beside `samples` and `sweeps`


class ImageError(InputError):
    """One image or label map that cannot be used; the rest of its drive can."""

    def __init__(self, code: str, file: str, detail: str, cure: str):
        super().__init__(f"{file}: {detail}; {cure}")
        self.code, self.file, self.detail, self.cure = code, file, detail, cure

    def reject(self, drive: str) -> Reject:
        """The same fact as a record of the drive."""
        return Reject(self.code, self.file, self.detail, self.cure, drive)


def read_rgb(file: Path, width_px: int, height_px: int, least_px: tuple[int, int] = (0, 0)) -> NDArray[np.uint8]:
    """A camera image (H, W, 3), which must have the given size; an EXIF rotation is ignored.

    With `least_px` (width, height) a JPEG is decoded at a half, a quarter or an eighth of its size if that is not
    smaller: libjpeg-turbo then leaves out most of the work. Intrinsics describe the sensor's rows and columns, which a
    rotation for viewing would swap. Raises ImageError if the file is missing, broken or of another size.
    """
    import cv2

    content = _content(file, "image", "restore the file or ingest the drive again")
    shrink = _shrink(content, (width_px, height_px), least_px)
    colour = {1: cv2.IMREAD_COLOR, 2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4}
    bgr = _decoded(content, colour.get(shrink, cv2.IMREAD_REDUCED_COLOR_8) | cv2.IMREAD_IGNORE_ORIENTATION)
    if bgr is None:
        cure = "copy the image again from its source"
        raise ImageError("image-broken", str(file), f"{len(content)} bytes that do not decode as an image", cure)
    if bgr.shape[:2] != (-(-height_px // shrink), -(-width_px // shrink)):
        width, height = bgr.shape[1] * shrink, bgr.shape[0] * shrink
        about = "" if shrink == 1 else "about "
        detail = f"the image is {about}{width} x {height} px, its table says {width_px} x {height_px}"
        raise ImageError("image-size", str(file), detail, "ingest the data set that the image belongs to")
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)


def _shrink(content: NDArray[np.uint8], size_px: tuple[int, int], least_px: tuple[int, int]) -> int:
    """By how much a JPEG may shrink while it is decoded: 1, 2, 4 or 8."""
    if content[:2].tobytes() != JPEG_START or min(least_px) <= 0:
        return 1
    room = min(size // least for size, least in zip(size_px, least_px, strict=True))
    return next(shrink for shrink in (8, 4, 2, 1) if shrink <= max(room, 1))


def read_labels(file: Path) -> NDArray[np.uint8]:
    """A label map (h, w) of Cityscapes train ids, 255 unknown. Raises ImageError if it is not one."""
    import cv2

    content = _content(file, "mask", "add the label map, or set features.masks to model")
    labels = _decoded(content, cv2.IMREAD_UNCHANGED)
    cure = "save it as an 8-bit grey PNG of Cityscapes train ids (0..18, 255 unknown)"
    if labels is None or labels.ndim != 2 or labels.dtype != np.uint8:
        found = "does not decode" if labels is None else f"decodes to {labels.dtype} of shape {labels.shape}"
        raise ImageError("mask-broken", str(file), f"the label map {found}", cure)
    present = np.flatnonzero(np.bincount(labels.ravel(), minlength=256))
    strange = [int(label) for label in present if len(classes.CITYSCAPES) <= label < classes.UNKNOWN]
    if strange:
        raise ImageError("mask-labels", str(file), f"the label map holds the ids {strange}", cure)
    return labels.astype(np.uint8, copy=False)


def mask_path(image_path: str) -> Path:
    """Where a data set keeps the label map of an image; both paths are relative to its root."""
    return Path(MASKS_FOLDER) / Path(image_path).with_suffix(".png")


def resized(rgb: NDArray[np.uint8], width_px: int, height_px: int) -> NDArray[np.uint8]:
    """The image at another size: area averages when it shrinks, bilinear when it grows."""
    import cv2

    height, width = rgb.shape[:2]
    if (width, height) == (width_px, height_px):
        return rgb
    method = cv2.INTER_AREA if width_px * height_px < width * height else cv2.INTER_LINEAR
    return cv2.resize(rgb, (width_px, height_px), interpolation=method).astype(np.uint8, copy=False)


def grey_level(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The brightness (H, W) of an image."""
    import cv2

    return cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.uint8, copy=False)


def enlarged(grey: NDArray[np.uint8], scale: int) -> NDArray[np.uint8]:
    """A grey image (H, W) with `scale` times the rows and columns, on cubic curves through the pixels that it had."""
    import cv2

    height, width = grey.shape
    size_px = scale * width, scale * height
    return cv2.resize(grey, size_px, interpolation=cv2.INTER_CUBIC).astype(np.uint8, copy=False)


def _content(file: Path, what: str, cure: str) -> NDArray[np.uint8]:
    try:
        return np.fromfile(file, np.uint8)
    except OSError as error:
        raise ImageError(f"{what}-missing", str(file), f"cannot be read ({error.strerror})", cure) from error


def _decoded(content: NDArray[np.uint8], flags: int) -> Any:
    """OpenCV's array, or None for what it cannot decode: it returns None, or raises on nothing and on huge sizes."""
    import cv2

    try:
        return cv2.imdecode(content, flags)
    except cv2.error:
        return None
