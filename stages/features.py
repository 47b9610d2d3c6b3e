"""The feature stage: camera images become label maps and features of the shared feature space."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from presight_core import classes
from presight_core.config import FeatureSettings
from presight_core.drives import Drive, FrameTable, Reject
from presight_core.errors import InputError
from presight_core.feature_space import FeatureSpace
from presight_core.images import ImageError, mask_path, read_labels, read_rgb
from presight_core.pixels import FrameLayers
from presight_core.progress import Progress, Report, silent
from stages.networks import FeatureExtractor
from stages.pipeline import Pipeline, Step
from stages.standing import Shot, standing_vehicles

__all__ = ["FeatureExtractor", "Item", "extract_drive", "read_image"]

Item: TypeAlias = tuple[int, FrameLayers | Reject]  # a row, and its layers or why there are none


def extract_drive(  # noqa: PLR0913, PLR0917 - the last two have defaults
    drive: Drive,
    frames: FrameTable,
    space: FeatureSpace,
    extractor: FeatureExtractor,
    settings: FeatureSettings,
    rows: NDArray[np.int64] | None = None,
    report: Report = silent,
) -> Iterator[Item]:
    """Label maps and features of a drive's frames, or of some `rows` of them, in order; a Reject where one is unusable.

    Label maps come from `segmentation/` of the data set or from the model, as `settings.masks` says. The report's
    figures are images a second and the share of time that each step is busy, of which `store` is the caller's own
    work between two items. Raises InputError if the space belongs to another model.
    """
    if space.model_sha256 != extractor.feature_card.sha256:
        raise InputError(
            f"feature space {space.space_id} was fitted on model {space.model_sha256[:12]}, "
            f"the feature model is {extractor.feature_card.sha256[:12]}; use that model, or fit a new space"
        )
    rows = np.arange(len(frames)) if rows is None else rows
    return _Extraction(drive, frames, space, extractor, settings).run(rows, report)


def read_image(drive: Drive, frames: FrameTable, row: int, least_px: tuple[int, int] = (0, 0)) -> NDArray[np.uint8]:
    """The image of a row, shrunk while decoding if it stays at least as large as `least_px` (width, height).

    Raises ImageError.
    """
    file = Path(drive.root) / str(frames.path[row])
    return read_rgb(file, int(frames.width_px[row]), int(frames.height_px[row]), least_px)


@dataclass(frozen=True)
class _Loaded:
    """One frame as read from the data set; labels are None where the model shall make them."""

    row: int
    rgb: NDArray[np.uint8]
    labels: NDArray[np.uint8] | None
    neighbour: Shot | None  # the image before or after it, where standing vehicles are wanted


@dataclass(frozen=True)
class _Batch:
    """Some frames on their way: the readable ones, the refused ones, and what the networks take and give."""

    loaded: list[_Loaded]
    refused: list[tuple[int, Reject]]
    feature_values: NDArray[np.float32]  # input, then output
    label_values: NDArray | None  # likewise; None where no frame needs the model


@dataclass(frozen=True)
class _Extraction:
    """One drive on its way through the networks."""

    drive: Drive
    frames: FrameTable
    space: FeatureSpace
    extractor: FeatureExtractor
    settings: FeatureSettings

    def run(self, rows: NDArray[np.int64], report: Report) -> Iterator[Item]:
        size = self.extractor.batch_size
        pipeline = Pipeline(
            [
                Step("read", self._read, self.extractor.threads),
                Step("prepare", self._prepare),
                Step("networks", self._infer),
                Step("project", self._project),
            ]
        )
        done, stored, started = 0, 0.0, perf_counter()
        for items in pipeline.run(rows[start : start + size] for start in range(0, len(rows), size)):
            before = perf_counter()
            yield from items
            stored += perf_counter() - before
            done += len(items)
            seconds = perf_counter() - started
            shares = {**pipeline.shares(), "store": stored / seconds}
            report(Progress("features", done, len(rows), {"images/s": done / seconds, **shares}))

    def _read(self, rows: NDArray[np.int64]) -> list[_Loaded | tuple[int, Reject]]:
        return [self._load(int(row)) for row in rows]

    def _load(self, row: int) -> _Loaded | tuple[int, Reject]:
        try:
            rgb = read_image(self.drive, self.frames, row, self.extractor.least_px)
            return _Loaded(row, rgb, self._precomputed_labels(row), self._neighbour(row))
        except ImageError as error:
            return row, error.reject(self.drive.name)

    def _precomputed_labels(self, row: int) -> NDArray[np.uint8] | None:
        if self.settings.masks == "model":
            return None
        file = Path(self.drive.root) / mask_path(str(self.frames.path[row]))
        if self.settings.masks == "auto" and not file.is_file():
            return None
        return read_labels(file)

    def _neighbour(self, row: int) -> Shot | None:
        """The frame before this one of its camera, or else the one after it, or else nothing."""
        if self.settings.parked_cars == "drop":
            return None
        for other in (row - 1, row + 1):
            if 0 <= other < len(self.frames) and self.frames.camera[other] == self.frames.camera[row]:
                try:
                    return self._shot(other, read_image(self.drive, self.frames, other, self.extractor.least_px))
                except ImageError:
                    continue
        return None

    def _shot(self, row: int, rgb: NDArray[np.uint8]) -> Shot:
        return Shot(rgb, self.frames.camera_of(row).scaled(rgb.shape[1], rgb.shape[0]))

    def _prepare(self, items: list[_Loaded | tuple[int, Reject]]) -> _Batch:
        loaded = [item for item in items if isinstance(item, _Loaded)]
        unlabelled = [item.rgb for item in loaded if item.labels is None]
        return _Batch(
            loaded,
            [item for item in items if not isinstance(item, _Loaded)],
            self.extractor.features.prepare([item.rgb for item in loaded]),
            self.extractor.segmentation.prepare(unlabelled) if unlabelled else None,
        )

    def _infer(self, batch: _Batch) -> _Batch:
        labels = None if batch.label_values is None else self.extractor.segmentation.infer(batch.label_values)
        return _Batch(batch.loaded, batch.refused, self.extractor.features.infer(batch.feature_values), labels)

    def _project(self, batch: _Batch) -> list[Item]:
        labels = iter(() if batch.label_values is None else batch.label_values.argmax(-1).astype(np.uint8))
        features = self.space.encode(batch.feature_values)
        done: list[Item] = [
            (item.row, FrameLayers(self._kept(item, next(labels) if item.labels is None else item.labels), values))
            for item, values in zip(batch.loaded, features, strict=True)
        ]
        return sorted([*done, *batch.refused], key=lambda item: item[0])

    def _kept(self, item: _Loaded, labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The labels, with vehicles that stand still unknown: like all that is not masked, they are then mapped."""
        if item.neighbour is None:
            return labels
        standing = standing_vehicles(labels, self._shot(item.row, item.rgb), item.neighbour)
        return np.where(standing, np.uint8(classes.UNKNOWN), labels)
