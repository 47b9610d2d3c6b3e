"""A field that goes on from an earlier one of the same tile, which had seen some of its drives."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from presight_core.drives import FrameTable
from presight_core.errors import InputError
from presight_core.field.checkpoint import load_field
from presight_core.field.tile_field import TileField

TABLES = ("video_embedding.weight", "image_embedding.weight", "lenses.terms")  # a row a video, image or lens


@dataclass(frozen=True)
class FieldStart:
    """The field to begin with."""

    folder: Path  # see `load_field`
    name: str  # digest of the recipe that made it: it decides the result
    drives: tuple[str, ...]  # that it was trained on


def go_on_from(
    start: FieldStart, field: TileField, frames: FrameTable, images: NDArray[np.int64], lenses: NDArray[np.int64]
) -> None:
    """Give a new field the parameters of an earlier one of the same shape.

    `images` (N,) are the frames' numbers in the embedding, -1 of those not trained on, `lenses` (N,) those of their
    cameras. Videos, images and cameras that the earlier field knew keep their rows, new ones begin with the mean of
    all, which is what evaluation shows. Raises NotFoundError or InputError if the earlier field is not there, damaged,
    or of another shape.
    """
    device = str(field.centroids.device)
    earlier = load_field(start.folder, device)
    kept = ("sub_fields", "settings", "feature_channels")
    different = [name for name in kept if getattr(earlier.shape, name) != getattr(field.shape, name)]
    if different:
        raise InputError(f"{start.folder}: another field's {', '.join(different)}; train the tile from nothing")
    tensors = dict(earlier.state_dict())
    names = np.unique(frames.drive_id)
    known = np.isin(frames.drive_id, start.drives)
    videos = np.flatnonzero(np.isin(names, start.drives))
    rows = videos, np.sort(images[known & (images >= 0)]), np.unique(lenses[known])
    counts = field.shape.video_count, field.shape.image_count, field.shape.lens_count
    for table, known_rows, count in zip(TABLES, rows, counts, strict=True):
        if table in tensors:
            tensors[table] = _spread_rows(tensors[table], known_rows, count)
    field.load_state_dict(tensors)


def _spread_rows(earlier: Tensor, rows: NDArray[np.int64], count: int) -> Tensor:
    """A table of `count` rows: the earlier ones at `rows`, their mean elsewhere.

    The mean everywhere if the numbers do not fit: then an image was refused, or came back, and rows cannot be told.
    """
    table = earlier.mean(0).repeat(count, 1)
    if len(rows) == len(earlier):
        table[torch.from_numpy(rows).to(table.device)] = earlier
    return table
