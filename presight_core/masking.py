"""Which pixels no field may learn from: what can move, a margin around it and, if wanted, its shadow.

Training, extraction and evaluation pass over pixels of the dynamic classes. So a pixel is masked by giving it such a
class, wherever pixels are read; the cached label maps stay as the network gave them.
"""

from typing import TYPE_CHECKING, Any

from presight_core import classes

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from presight_core.config import FeatureSettings

GROUND = ("road", "sidewalk", "terrain")
SHADOW_REACH = 0.06  # of the image's height: how far from an object its shadow is looked for
SHADOW_DARKNESS = 0.7  # of the median brightness of the ground around: the sun's share of light on a road is above half


def recipe(settings: "FeatureSettings") -> dict[str, Any]:
    """What decides the masked pixels besides the classes, as JSON values."""
    return {"margin": settings.dynamic_margin, "shadows": settings.mask_shadows}


def masked_labels(
    labels: "NDArray[np.uint8]", rgb: "NDArray[np.uint8]", settings: "FeatureSettings"
) -> "NDArray[np.uint8]":
    """The label map (h, w) in which every pixel to pass over has a dynamic class; `rgb` is its image, of any size."""
    import numpy as np

    moving = classes.lookup(settings.dynamic_classes)[labels]
    if not moving.any():
        return labels
    masked = _grown(moving, settings.dynamic_margin)
    if settings.mask_shadows:
        masked = masked | _shadows(labels, rgb, masked, settings.dynamic_margin)
    inside = np.uint8(classes.CITYSCAPES.index(settings.dynamic_classes[0]))
    return np.where(masked & ~moving, inside, labels)


def masked_share(labels: "NDArray[np.uint8]", settings: "FeatureSettings") -> float:
    """The share of pixels of a masked label map that are passed over."""
    return float(classes.lookup(settings.dynamic_classes)[labels].mean())


def _grown(mask: "NDArray[np.bool_]", share: float) -> "NDArray[np.bool_]":
    """The mask and everything within a share of the image's height of it."""
    import cv2
    import numpy as np

    radius = round(share * mask.shape[0])
    if radius == 0:
        return mask
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return cv2.dilate(mask.astype(np.uint8), disc) > 0


def _shadows(
    labels: "NDArray[np.uint8]", rgb: "NDArray[np.uint8]", masked: "NDArray[np.bool_]", margin: float
) -> "NDArray[np.bool_]":
    """Ground near masked pixels that is much darker than the ground of its image, with a margin."""
    import cv2
    import numpy as np

    height, width = labels.shape
    grey = cv2.cvtColor(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
    ground = classes.lookup(GROUND)[labels] & ~masked
    if not ground.any():
        return np.zeros_like(masked)
    dark = ground & _grown(masked, SHADOW_REACH) & (grey < SHADOW_DARKNESS * np.median(grey[ground]))
    return _grown(dark, margin) & ~masked
