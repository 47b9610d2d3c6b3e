"""Random crops and camera faults: they make a network trained on drawn streets less helpless on photographs."""

import cv2
import numpy as np
from numpy.typing import NDArray

from presight_core.classes import UNKNOWN

WHOLE_CROP_PX = 224, 192  # height, width: half an image, so that a batch holds twice as many different ones
COARSE_CROP_PX = 112, 192  # nearly a whole image at half its scale
STRETCHED_SHARE = 0.35  # of the samples; the others keep the scale at which the city is rendered
FAULTY_SHARE = 0.35  # of the samples: with faults in all of them, cars took three times as long to be learned
RARE = 0.03  # a class of fewer pixels than this share is sought
SEEN_PX = 60  # in images that show at least so many pixels of it
GREY_SHARE = 0.4  # of the faulty samples: drives with grey cameras exist


class Finder:
    """Chooses what to look at: any image, or a place of a class that fills little of the images."""

    def __init__(self, labels: NDArray[np.uint8], rare_share: float, rng: np.random.Generator):
        self._labels, self._rare_share, self._rng = labels, rare_share, rng
        counts = np.stack([np.bincount(each.ravel(), minlength=UNKNOWN + 1)[:UNKNOWN] for each in labels])
        share = counts.sum(0) / labels.size
        self._rare = [c for c in np.flatnonzero(share) if share[c] < RARE and (counts[:, c] >= SEEN_PX).any()]
        self._images = {c: np.flatnonzero(counts[:, c] >= SEEN_PX) for c in self._rare}

    def place(self) -> tuple[int, tuple[float, float] | None]:
        """An image's number, and a pixel (row, column) to look at or None."""
        if not self._rare or self._rng.random() >= self._rare_share:
            return int(self._rng.integers(len(self._labels))), None
        wanted = self._rng.choice(self._rare)
        image = int(self._rng.choice(self._images[wanted]))
        pixels = np.flatnonzero(self._labels[image] == wanted)
        row, column = divmod(int(self._rng.choice(pixels)), self._labels.shape[2])
        return image, (row, column)


def random_crop(
    rgb: NDArray[np.uint8],
    labels: NDArray[np.uint8],
    size_px: tuple[int, int],
    rng: np.random.Generator,
    focus: tuple[float, float] | None = None,
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """A part of an image and of its label map, scaled to `size_px` (height, width), maybe mirrored or stretched.

    Stretched, because every image is brought to 16:9, whatever its own shape. `focus` (row, column) is a place that
    the part shows, somewhere off its border.
    """
    height, width = labels.shape
    crop_height, crop_width = size_px
    zoom_y = zoom_x = crop_height / height
    if rng.random() < STRETCHED_SHARE:
        zoom_y *= np.exp(rng.uniform(0.0, 0.5))
        zoom_x = zoom_y * np.exp(rng.uniform(-0.65, 0.2))  # -0.6 is what a panorama of 3.3:1 suffers
    zoom_x = max(zoom_x, crop_width / width)
    top = _start(height, crop_height / zoom_y, focus and focus[0], rng)
    left = _start(width, crop_width / zoom_x, focus and focus[1], rng)
    # Both grids have their first pixel's centre at 0.5, OpenCV's at 0.
    crop_from_image = np.array(
        [[zoom_x, 0, (0.5 - left) * zoom_x - 0.5], [0, zoom_y, (0.5 - top) * zoom_y - 0.5]], np.float64
    )
    if rng.random() < 0.5:
        crop_from_image[0] = [-crop_from_image[0, 0], 0, crop_width - 1 - crop_from_image[0, 2]]
    size = crop_width, crop_height
    crop = cv2.warpAffine(rgb, crop_from_image, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    crop_labels = cv2.warpAffine(
        labels, crop_from_image, size, flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=UNKNOWN
    )
    return crop.astype(np.uint8, copy=False), crop_labels.astype(np.uint8, copy=False)


def _start(length: float, part: float, focus: float | None, rng: np.random.Generator) -> float:
    """Where a part of a length begins, anywhere or such that it holds the focus."""
    if focus is None:
        return rng.uniform(0, length - part)
    return float(np.clip(focus - part * rng.uniform(0.15, 0.85), 0, length - part))


def another_camera(rgb: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.float32]:
    """The image (H, W, 3) in 0..1 as another camera might have taken it: grey, off-colour, dark, blurred, noisy."""
    image: NDArray[np.floating] = rgb.astype(np.float32) / 255
    if rng.random() > FAULTY_SHARE:
        return image.astype(np.float32, copy=False)
    if rng.random() < 0.4:
        image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.3, 1.3)).astype(np.float32)
    image = _recoloured(image, rng)
    if rng.random() < 0.8:
        gamma, contrast, brightness = np.exp(rng.normal(0, 0.3)), rng.uniform(0.65, 1.35), rng.normal(0, 0.08)
        image = (np.clip(image, 1e-3, 1) ** np.float32(gamma) - 0.5) * np.float32(contrast)
        image += np.float32(0.5 + brightness)
    if rng.random() < 0.3:
        image = image + rng.standard_normal(image.shape, np.float32) * np.float32(rng.uniform(0.005, 0.05))
    return np.clip(image, 0, 1).astype(np.float32, copy=False)


def _recoloured(image: NDArray[np.floating], rng: np.random.Generator) -> NDArray[np.floating]:
    if rng.random() < GREY_SHARE:
        weights = rng.dirichlet((3, 5, 2)).astype(np.float32)  # about the eye's, as sensors differ
        return np.repeat((image @ weights)[..., None], 3, axis=2)
    grey = image.mean(axis=2, keepdims=True)
    saturation = np.float32(rng.uniform(0.4, 1.4))
    balance = np.exp(rng.normal(0, 0.08, 3)).astype(np.float32)
    return (grey + (image - grey) * saturation) * balance
