"""Pixels, label maps and features of frames, from the data sets' images and the feature cache."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from presight_core.config import CitySettings
from presight_core.drives import FrameTable
from presight_core.errors import NotFoundError
from presight_core.images import read_rgb, resized
from presight_core.masking import masked_labels
from presight_core.pixels import FramePixels, PixelSource
from storage.features import FeatureCache


class CachedPixels(PixelSource):
    """Loads the rows of one FrameTable; safe to call from several threads."""

    def __init__(
        self, frames: FrameTable, roots: Mapping[str, str | Path], cache: FeatureCache, key: str, settings: CitySettings
    ):
        """`roots` gives the data set's folder of each drive; `settings` how small images are and what is masked.

        Raises NotFoundError if a frame is not in the feature cache under `key`.
        """
        self._frames, self._cache, self._key, self._settings = frames, cache, key, settings
        self._roots = {drive_id: Path(root) for drive_id, root in roots.items()}
        self._cache_rows = _cache_rows(frames, cache, key)

    def load(self, row: int) -> FramePixels:
        """Decode one row; what is masked has a dynamic class.

        Raises InputError if the image cannot be read or was rejected by the feature stage.
        """
        drive_id = str(self._frames.drive_id[row])
        layers = self._cache.read(self._key, drive_id, int(self._cache_rows[row]))
        rgb = self._load_rgb(row)
        return FramePixels(rgb, masked_labels(layers.labels, rgb, self._settings.features), layers.features)

    def load_view(self, row: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Pixels and labels of `load`, at a fraction of its cost."""
        labels = self._read_labels(row)
        rgb = self._load_rgb(row)
        return rgb, masked_labels(labels, rgb, self._settings.features)

    def load_labels(self, row: int) -> NDArray[np.uint8]:
        """The labels of `load` alone, at a fraction of its cost where masks need no image."""
        labels = self._read_labels(row)
        needs_image = self._settings.features.mask_shadows
        rgb = self._load_rgb(row) if needs_image else np.zeros((1, 1, 3), np.uint8)
        return masked_labels(labels, rgb, self._settings.features)

    def _read_labels(self, row: int) -> NDArray[np.uint8]:
        return self._cache.read_labels(self._key, str(self._frames.drive_id[row]), int(self._cache_rows[row]))

    def _load_rgb(self, row: int) -> NDArray[np.uint8]:
        frames = self._frames
        width, height = int(frames.width_px[row]), int(frames.height_px[row])
        rgb = read_rgb(self._roots[str(frames.drive_id[row])] / str(frames.path[row]), width, height)
        scale = self._settings.training.image_scale
        return resized(rgb, max(1, round(width * scale)), max(1, round(height * scale)))


def _cache_rows(frames: FrameTable, cache: FeatureCache, key: str) -> np.ndarray:
    """The feature cache's row of every frame (N,): a tile's frames are a choice of their drives' frames."""
    rows = np.zeros(len(frames), np.int64)
    known = {str(drive_id): cache.rows_of(key, str(drive_id)) for drive_id in np.unique(frames.drive_id)}
    for row, (drive_id, path) in enumerate(zip(frames.drive_id.tolist(), frames.path.tolist(), strict=True)):
        if path not in known[drive_id]:
            raise NotFoundError(f"{path}: not in the features of drive {drive_id}; run the feature stage again")
        rows[row] = known[drive_id][path]
    return rows
