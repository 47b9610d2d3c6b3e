"""Fitting the shared feature space: the principal directions of a network's patches, and a range for each."""

from collections.abc import Iterable, Iterator
from operator import length_hint

import numpy as np
from numpy.typing import NDArray

from presight_core.config import FeatureSettings
from presight_core.drives import Drive, FrameTable
from presight_core.errors import InputError
from presight_core.feature_space import FeatureSpace
from presight_core.images import ImageError
from presight_core.model_card import ModelCard
from presight_core.progress import Progress, Report, silent
from stages.features import read_image
from stages.networks import FeatureExtractor

CAMERAS_PER_DRIVE = 3  # the released code fits the space on the first frame of three cameras of every scene
RANGE_PERCENTILES = (1, 99)  # of each channel: rare patches must not squeeze all others into a few of 256 steps
DEAD_RANGE = 1e-6  # of the widest channel: a narrower one is rounding noise, and stays near zero
CHUNK_PATCHES = 1 << 14  # patches in float64 at a time: 100 MB for 768 channels


class SpaceImages:
    """The images that the feature space is fitted on: the first keyframe of up to three cameras of every drive.

    Drives go in the order of their ids. An image that cannot be read is passed over. Images are read one by one.
    """

    def __init__(self, drives: Iterable[tuple[Drive, FrameTable]]):
        ordered = sorted(drives, key=lambda pair: pair[0].drive_id)
        self._chosen = [(drive, frames, row) for drive, frames in ordered for row in _space_rows(frames)]

    def __length_hint__(self) -> int:
        return len(self._chosen)

    def __iter__(self) -> Iterator[NDArray[np.uint8]]:
        for drive, frames, row in self._chosen:
            try:
                yield read_image(drive, frames, row)
            except ImageError:
                continue


def fit_space(
    images: Iterable[NDArray[np.uint8]],
    extractor: FeatureExtractor,
    settings: FeatureSettings,
    report: Report = silent,
) -> FeatureSpace:
    """The feature space of RGB images: principal directions, each scaled by its 1..99 % range to [0, 1].

    The directions are those of all patches, image by image, so that memory does not grow with them; ranges come from
    an even sample of at most `settings.sample_patches`. The same images give the same space. It has
    `settings.channels` channels, or as many as the model. Raises InputError without images.
    """
    sample, moments = _PatchSample(settings.sample_patches), _Moments()
    total = length_hint(images)
    for done, image in enumerate(images, 1):
        patches = extractor.raw_features([image])[0]
        patches = patches.reshape(-1, patches.shape[-1])
        sample.add(patches)
        moments.add(patches)
        report(Progress("feature space", done, max(total, done)))
    if not moments.count:
        raise InputError("no image to fit the feature space on; check that the drives' images can be read")
    return _space_of(moments, sample.patches, settings.channels, extractor.feature_card)


def _space_rows(frames: FrameTable) -> list[int]:
    """First keyframe (or frame, where there is none) of up to three cameras, spread over the cameras' names."""
    cameras = np.unique(frames.camera)
    spread = cameras[:: -(-len(cameras) // CAMERAS_PER_DRIVE)]
    order = np.lexsort((frames.timestamp_us, ~frames.is_keyframe))
    return [int(order[np.argmax(frames.camera[order] == camera)]) for camera in spread]


class _Moments:
    """Mean and covariance of a stream of patches, in float64. Memory: one matrix (D, D), whatever the stream."""

    def __init__(self) -> None:
        self.count = 0

    def add(self, patches: NDArray[np.float32]) -> None:
        """Take the patches (N, D) of the next image."""
        if not self.count:
            # Sums are kept about the first image's mean: about zero, a large mean would eat the variance's digits.
            self._origin = patches.mean(0, dtype=np.float64)
            self._sum = np.zeros_like(self._origin)
            self._squares = np.zeros((len(self._origin), len(self._origin)))
        for start in range(0, len(patches), CHUNK_PATCHES):
            centred = patches[start : start + CHUNK_PATCHES] - self._origin
            self._sum += centred.sum(0)
            self._squares += centred.T @ centred
        self.count += len(patches)

    @property
    def mean(self) -> NDArray[np.float64]:
        """The mean patch (D,)."""
        return self._origin + self._sum / self.count

    @property
    def covariance(self) -> NDArray[np.float64]:
        """The patches' covariance (D, D)."""
        shift = self._sum / self.count
        return self._squares / self.count - np.outer(shift, shift)


class _PatchSample:
    """An even sample of at most `limit` patches of a stream of images: every 2^n-th patch, n growing as needed."""

    def __init__(self, limit: int):
        self._parts: list[NDArray[np.float32]] = []
        self._limit, self._stride, self._seen, self._images = limit, 1, 0, 0

    @property
    def patches(self) -> NDArray[np.float32]:
        """The sample (N, D)."""
        return np.concatenate(self._parts)

    def add(self, patches: NDArray[np.float32]) -> None:
        """Take some of the patches (N, D) of the next image."""
        # Shuffled, because a stride of 2^n would fall on the same few columns in every row.
        shuffled = np.random.default_rng(self._images).permutation(patches)
        self._parts.append(shuffled[-self._seen % self._stride :: self._stride])
        self._seen += len(patches)
        self._images += 1
        while sum(map(len, self._parts)) > self._limit:
            self._parts = [self.patches[::2].copy()]
            self._stride *= 2


def _space_of(moments: _Moments, sample: NDArray[np.float32], channels: int, card: ModelCard) -> FeatureSpace:
    variances, directions = _principal_directions(moments.covariance)
    components = directions[:channels].astype(np.float32)
    projected = (sample - moments.mean.astype(np.float32)) @ components.T
    low, high = np.percentile(projected, RANGE_PERCENTILES, axis=0)
    dead = high - low <= DEAD_RANGE * (high - low).max()
    explained = variances[:channels] / max(variances.sum(), np.finfo(np.float64).tiny)
    return FeatureSpace(
        mean=moments.mean.astype(np.float32),
        components=components,
        low=low.astype(np.float32),
        high=np.where(dead, low + 1, high).astype(np.float32),
        explained=explained.astype(np.float32),
        model_sha256=card.sha256,
    )


def _principal_directions(covariance: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Variances (D,), largest first, and unit directions (D, D), a row each.

    A direction's sign is free; here its largest entry is positive, so that equal data give equal spaces.
    """
    variances, vectors = np.linalg.eigh(covariance)
    directions = vectors[:, ::-1].T
    largest = directions[np.arange(len(directions)), np.abs(directions).argmax(-1)]
    return np.maximum(variances[::-1], 0), directions * np.where(largest < 0, -1, 1)[:, None]
