"""The feature stage: camera images become label maps and features of the shared feature space."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from operator import length_hint
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from presight_core.config import FeatureSettings
from presight_core.drives import Drive, FrameTable, Reject
from presight_core.errors import InputError
from presight_core.feature_space import FeatureSpace
from presight_core.images import ImageError, mask_path, read_labels, read_rgb
from presight_core.model_card import ModelCard
from presight_core.pixels import FrameLayers
from presight_core.progress import Progress, Report, silent
from stages.networks import FeatureExtractor

__all__ = ["FeatureExtractor", "extract_drive", "fit_space", "space_images"]

CAMERAS_PER_DRIVE = 3  # the released code fits the space on the first frame of three cameras of every scene
RANGE_PERCENTILES = (1, 99)  # of each channel: rare patches must not squeeze all others into a few of 256 steps
DEAD_RANGE = 1e-6  # of the widest channel: a narrower one is rounding noise, and stays near zero
CHUNK_PATCHES = 1 << 14  # patches in float64 at a time: 100 MB for 768 channels


def space_images(drives: Iterable[tuple[Drive, FrameTable]]) -> Iterator[NDArray[np.uint8]]:
    """The images that the feature space is fitted on: the first keyframe of up to three cameras of every drive.

    Drives go in the order of their ids. An image that cannot be read is passed over.
    """
    for drive, frames in sorted(drives, key=lambda pair: pair[0].drive_id):
        for row in _space_rows(frames):
            try:
                yield _read_image(drive, frames, row)
            except ImageError:
                continue


def fit_space(
    images: Iterable[NDArray[np.uint8]],
    extractor: FeatureExtractor,
    settings: FeatureSettings,
    report: Report = silent,
) -> FeatureSpace:
    """The feature space of RGB images: principal directions, each scaled by its 1..99 % range to [0, 1].

    Fitted on a thinned sample of at most `settings.sample_patches` patches; the same images give the same space.
    It has `settings.channels` channels, or as many as the model. Raises InputError without images.
    """
    sample = _PatchSample(settings.sample_patches)
    total = length_hint(images)
    for done, image in enumerate(images, 1):
        sample.add(extractor.raw_features([image])[0])
        report(Progress("feature space", done, max(total, done)))
    if len(sample.patches) == 0:
        raise InputError("no image to fit the feature space on; check that the drives' images can be read")
    return _space_of(sample.patches, settings.channels, extractor.feature_card)


def extract_drive(
    drive: Drive,
    frames: FrameTable,
    space: FeatureSpace,
    extractor: FeatureExtractor,
    settings: FeatureSettings,
    report: Report = silent,
) -> Iterator[tuple[int, FrameLayers] | Reject]:
    """Label maps and features of a drive's frames: one item a row, in order; a Reject where the image is unusable.

    Label maps come from `segmentation/` of the data set or from the model, as `settings.masks` says. Raises
    InputError if the space belongs to another model.
    """
    if space.model_sha256 != extractor.feature_card.sha256:
        raise InputError(
            f"feature space {space.space_id} was fitted on model {space.model_sha256[:12]}, "
            f"the feature model is {extractor.feature_card.sha256[:12]}; use that model, or fit a new space"
        )
    return _Extraction(drive, frames, space, extractor, settings.masks).run(report)


@dataclass(frozen=True)
class _Loaded:
    """One frame as read from the data set; labels are None where the model shall make them."""

    rgb: NDArray[np.uint8]
    labels: NDArray[np.uint8] | None


@dataclass(frozen=True)
class _Extraction:
    """One drive on its way through the networks."""

    drive: Drive
    frames: FrameTable
    space: FeatureSpace
    extractor: FeatureExtractor
    masks: str

    def run(self, report: Report) -> Iterator[tuple[int, FrameLayers] | Reject]:
        started = perf_counter()
        total = len(self.frames)
        done = 0
        for loaded in _ahead(self._load, total, self.extractor.batch_size, self.extractor.threads):
            for row, item in enumerate(self._layers(loaded), done):
                yield item if isinstance(item, Reject) else (row, item)
            done += len(loaded)
            report(Progress("features", done, total, {"images/s": done / (perf_counter() - started)}))

    def _load(self, row: int) -> _Loaded | Reject:
        try:
            return _Loaded(_read_image(self.drive, self.frames, row), self._precomputed_labels(row))
        except ImageError as error:
            return error.reject(self.drive.name)

    def _precomputed_labels(self, row: int) -> NDArray[np.uint8] | None:
        if self.masks == "model":
            return None
        file = Path(self.drive.root) / mask_path(str(self.frames.path[row]))
        if self.masks == "auto" and not file.is_file():
            return None
        return read_labels(file)

    def _layers(self, loaded: list[_Loaded | Reject]) -> list[FrameLayers | Reject]:
        """Layers of one batch, in its order."""
        images = [item.rgb for item in loaded if isinstance(item, _Loaded)]
        unlabelled = [item.rgb for item in loaded if isinstance(item, _Loaded) and item.labels is None]
        features = iter(self.space.encode(self.extractor.raw_features(images)) if images else ())
        labels = iter(self.extractor.labels(unlabelled) if unlabelled else ())
        return [
            item
            if isinstance(item, Reject)
            else FrameLayers(next(labels) if item.labels is None else item.labels, next(features))
            for item in loaded
        ]


def _ahead(
    load: Callable[[int], _Loaded | Reject], total: int, batch_size: int, threads: int
) -> Iterator[list[_Loaded | Reject]]:
    """Rows 0..total-1 in batches; the next batch is read while the caller works on this one."""
    with ThreadPoolExecutor(threads) as pool:
        waiting: list[list[Future]] = []
        for start in range(0, total, batch_size):
            waiting.append([pool.submit(load, row) for row in range(start, min(start + batch_size, total))])
            if len(waiting) > 1:
                yield [future.result() for future in waiting.pop(0)]
        for batch in waiting:
            yield [future.result() for future in batch]


def _read_image(drive: Drive, frames: FrameTable, row: int) -> NDArray[np.uint8]:
    file = Path(drive.root) / str(frames.path[row])
    return read_rgb(file, int(frames.width_px[row]), int(frames.height_px[row]))


def _space_rows(frames: FrameTable) -> list[int]:
    """First keyframe (or frame, where there is none) of up to three cameras, spread over the cameras' names."""
    cameras = np.unique(frames.camera)
    spread = cameras[:: -(-len(cameras) // CAMERAS_PER_DRIVE)]
    order = np.lexsort((frames.timestamp_us, ~frames.is_keyframe))
    return [int(order[np.argmax(frames.camera[order] == camera)]) for camera in spread]


class _PatchSample:
    """An even sample of at most `limit` patches of a stream of images: every 2^n-th patch, n growing as needed."""

    def __init__(self, limit: int):
        self.patches = np.zeros((0, 0), np.float32)
        self._limit, self._stride, self._seen, self._images = limit, 1, 0, 0

    def add(self, features: NDArray[np.float32]) -> None:
        """Take part of the patches (rows, columns, D) of the next image."""
        # Shuffled, because a stride of 2^n would fall on the same few columns in every row.
        patches = np.random.default_rng(self._images).permutation(features.reshape(-1, features.shape[-1]))
        taken = patches[-self._seen % self._stride :: self._stride]
        self.patches = np.concatenate([self.patches, taken]) if self._images else taken
        self._seen += len(patches)
        self._images += 1
        while len(self.patches) > self._limit:
            self.patches = self.patches[::2]
            self._stride *= 2


def _space_of(patches: NDArray[np.float32], channels: int, card: ModelCard) -> FeatureSpace:
    mean = patches.mean(0, dtype=np.float64)
    variances, directions = _principal_directions(patches, mean)
    components = directions[:channels].astype(np.float32)
    projected = (patches - mean.astype(np.float32)) @ components.T
    low, high = np.percentile(projected, RANGE_PERCENTILES, axis=0)
    dead = high - low <= DEAD_RANGE * (high - low).max()
    explained = variances[:channels] / max(variances.sum(), np.finfo(np.float64).tiny)
    return FeatureSpace(
        mean=mean.astype(np.float32),
        components=components,
        low=low.astype(np.float32),
        high=np.where(dead, low + 1, high).astype(np.float32),
        explained=explained.astype(np.float32),
        model_sha256=card.sha256,
    )


def _principal_directions(
    patches: NDArray[np.float32], mean: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Variances (D,), largest first, and unit directions (D, D), a row each.

    A direction's sign is free; here its largest entry is positive, so that equal data give equal spaces.
    """
    covariance = np.zeros((len(mean), len(mean)))
    for start in range(0, len(patches), CHUNK_PATCHES):
        centred = patches[start : start + CHUNK_PATCHES] - mean
        covariance += centred.T @ centred
    variances, vectors = np.linalg.eigh(covariance / len(patches))
    directions = vectors[:, ::-1].T
    largest = directions[np.arange(len(directions)), np.abs(directions).argmax(-1)]
    return np.maximum(variances[::-1], 0), directions * np.where(largest < 0, -1, 1)[:, None]
