"""Training rays on the card: decoded images lie in its memory, and a batch is drawn without the host.

What a batch may hold never depends on what it does hold, so that the drawing can be part of a CUDA graph:
instead of throwing away pixels of moving things, the pixels that show none are listed once for each image.
"""

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from presight_core import classes
from presight_core.errors import InputError
from presight_core.field.lens import off_centre
from presight_core.field.tile_field import Rays
from presight_core.pixels import FramePixels, PixelSource
from stages.ray_pool import THIN, choose_images

HOST_BYTES = 3 << 30  # of a pool where the device is no card
CARD_SHARE = 0.25  # of the card's free memory; the rest is for activations
INDEX_BYTES = 4  # of a pixel in the list of those that show nothing dynamic


@dataclass(frozen=True)
class Targets:
    """What the images show where rays go, on the field's device."""

    rgb: Tensor  # (R, 3) uint8
    labels: Tensor  # (R,) uint8, Cityscapes train ids, 255 unknown
    features: Tensor  # (R, C) uint8, 255 = 1.0


@dataclass(frozen=True)
class PoolFrames:
    """The frames that a pool may hold, one row each."""

    rows: NDArray[np.int64]  # of the pixel source
    origins: NDArray[np.float32]  # (F, 3) field frame
    world_from_pixel: NDArray[np.float32]  # (F, 3, 3) directions of homogeneous pixels, of any length
    sizes_px: NDArray[np.int64]  # (F, 2) width and height of the frame that pixels count in
    videos: NDArray[np.int64]  # (F,) number of the embedding
    images: NDArray[np.int64]  # (F,) likewise
    lenses: NDArray[np.int64]  # (F,) number of the camera that took it
    sub_fields: NDArray[np.int64]  # (F,) nearest to the camera


@dataclass(frozen=True)
class Choice:
    """Which pixels are drawn."""

    dynamic_classes: tuple[str, ...]  # never
    thin_weight: float = 1.0  # how much likelier than others those of THIN classes are
    seed: int = 0  # of the frames of an epoch


@dataclass(frozen=True)
class _Loaded:
    """One decoded image, and its pixels (row by row) that show nothing dynamic, those of thin things last."""

    pixels: FramePixels
    static: NDArray[np.int32]
    thin_count: int

    @property
    def grids(self) -> dict[str, NDArray]:
        """What lies in the pool's buffers, an entry a row."""
        pixels = self.pixels
        return {
            "rgb": pixels.rgb.reshape(-1, 3),
            "labels": pixels.labels.reshape(-1),
            "features": pixels.features.reshape(-1, pixels.features.shape[-1]),
            "static": self.static,
        }


class CardPool:
    """Images in buffers of a device, and random rays through them.

    A pool that cannot hold all frames holds others in the next epoch, in the same buffers; they are decoded
    while the present ones are in use. `version` rises when buffers had to be replaced by larger ones.
    """

    def __init__(self, frames: PoolFrames, source: PixelSource, choice: Choice, device: str, threads: int = 1) -> None:
        """Nothing is decoded yet; see `show`. Raises InputError if the first image cannot be read."""
        self.version = 0
        self._frames, self._source, self._device = frames, source, device
        self._choice = choice
        self._is_dynamic, self._is_thin = classes.lookup(choice.dynamic_classes), classes.lookup(THIN)
        self._executor = ThreadPoolExecutor(threads)
        self._coming: tuple[int, list[Future[_Loaded]]] | None = None
        self._epoch = -1
        self._tensors: dict[str, Tensor] = {}
        self.capacity = min(len(frames.rows), self._room())

    @property
    def changes(self) -> bool:
        """Whether there are more frames than the pool can hold."""
        return self.capacity < len(self._frames.rows)

    def show(self, epoch: int) -> None:
        """Hold the images of an epoch, and begin to decode those of the next.

        Raises InputError if an image cannot be read, or all show hardly anything but dynamic things.
        """
        epoch = epoch if self.changes else 0
        if epoch == self._epoch:
            return
        coming, futures = self._coming or (-1, [])
        if coming != epoch:
            futures = self._load(epoch)
        self._fill(self._choose(epoch), [future.result() for future in futures])
        self._epoch = epoch
        self._coming = (epoch + 1, self._load(epoch + 1)) if self.changes else None

    def draw(self, noise: Tensor) -> tuple[Rays, Targets]:
        """A ray and its targets for each row of uniform random numbers (R, 2).

        A sub-field at random, a camera nearest to it, a pixel of that; pixels of dynamic things are passed over, and
        of the others too if `thin_weight` says so.
        """
        buffers = self._tensors
        image = torch.searchsorted(buffers["reached"], noise[:, 0].contiguous(), right=True)
        count, thin_count = buffers["static_counts"][image], buffers["thin_counts"][image]
        # Thin things come last in an image's list, and are `thin_weight` as long there as elsewhere.
        others, weight = count - thin_count, self._choice.thin_weight
        place = noise[:, 1] * (others + weight * thin_count)
        place = torch.where(place < others, place, others + (place - others) / weight)
        place = torch.minimum(place.long(), count - 1)  # float32 may round up to the count
        pixel = buffers["static"][buffers["static_starts"][image] + place].long()
        size = buffers["rgb_sizes"][image]
        column, row = pixel % size[:, 0], pixel // size[:, 0]
        unit = (torch.stack([column, row], -1) + 0.5) / size
        frame_pixel = torch.cat([unit * buffers["sizes_px"][image], torch.ones_like(unit[:, :1])], -1)
        directions = torch.einsum("nij,nj->ni", buffers["world_from_pixel"][image], frame_pixel)
        directions = directions / directions.norm(dim=-1, keepdim=True)
        numbers = (buffers[name][image] for name in ("videos", "images", "lenses"))
        places = off_centre(unit, buffers["sizes_px"][image])
        rays = Rays(buffers["origins"][image], directions, *numbers, off_centre=places)
        return rays, Targets(*(self._at(name, image, unit) for name in ("rgb", "labels", "features")))

    def close(self) -> None:
        """Stop decoding."""
        self._executor.shutdown(cancel_futures=True)

    def _at(self, name: str, image: Tensor, unit: Tensor) -> Tensor:
        """Values of the grid cells that hold places (R, 2), x and y in 0..1 of the image."""
        size = self._tensors[f"{name}_sizes"][image]
        cell = torch.minimum((unit * size).long(), size - 1)
        return self._tensors[name][self._tensors[f"{name}_starts"][image] + cell[:, 1] * size[:, 0] + cell[:, 0]]

    def _room(self) -> int:
        """How many images fit."""
        first = self._load_one(0)
        rgb, of_image = first.pixels.rgb, sum(grid.nbytes for grid in first.grids.values())
        of_image += rgb.shape[0] * rgb.shape[1] * INDEX_BYTES - first.static.nbytes  # as if nothing were dynamic
        on_card = self._device.startswith("cuda")
        room = torch.cuda.mem_get_info(self._device)[0] * CARD_SHARE if on_card else HOST_BYTES
        return max(1, int(room) // of_image)

    def _choose(self, epoch: int) -> NDArray[np.int64]:
        return choose_images(
            self._frames.sub_fields, self.capacity, np.random.default_rng([self._choice.seed, epoch, 1])
        )

    def _load(self, epoch: int) -> list[Future[_Loaded]]:
        return [self._executor.submit(self._load_one, frame) for frame in self._choose(epoch).tolist()]

    def _load_one(self, frame: int) -> _Loaded:
        pixels = self._source.load(int(self._frames.rows[frame]))
        # Label cells that hold the middles (i + 1/2) / count of the pixels' rows and columns.
        cells = (
            (2 * np.arange(count) + 1) * label_count // (2 * count)
            for count, label_count in zip(pixels.rgb.shape[:2], pixels.labels.shape, strict=True)
        )
        labels = pixels.labels[np.ix_(*cells)]
        is_thin = self._is_thin[labels] & ~self._is_dynamic[labels]
        thin = np.flatnonzero(is_thin)
        others = np.flatnonzero(~is_thin & ~self._is_dynamic[labels])
        return _Loaded(pixels, np.concatenate([others, thin]).astype(np.int32), len(thin))

    def _fill(self, chosen: NDArray[np.int64], images: Sequence[_Loaded]) -> None:
        frames = self._frames
        counts = np.array([len(image.static) for image in images])
        thin_counts = np.array([image.thin_count for image in images])
        sizes = np.array([[grid.shape[1::-1] for grid in _grids(image)] for image in images], np.int64)
        weights = counts + (self._choice.thin_weight - 1) * thin_counts
        cameras = np.bincount(frames.sub_fields[chosen])[frames.sub_fields[chosen]]
        share = weights / sizes[:, 0].prod(-1) / cameras
        if not counts.any():
            raise InputError(
                f"{len(chosen)} images show nothing but {', '.join(self._choice.dynamic_classes)}; "
                "check their label maps, or shorten features.dynamic_classes"
            )
        reached = (np.cumsum(share) / share.sum()).astype(np.float32)
        reached[np.flatnonzero(counts)[-1] :] = 1  # random numbers are below
        values = {"reached": reached, "static_counts": counts, "thin_counts": thin_counts}
        values |= {f"{name}_sizes": sizes[:, i] for i, name in enumerate(("rgb", "labels", "features"))}
        values |= {
            name: getattr(frames, name)[chosen]
            for name in ("origins", "world_from_pixel", "sizes_px", "videos", "images", "lenses")
        }
        for name in images[0].grids:
            grids = [image.grids[name] for image in images]
            ends = np.cumsum([len(grid) for grid in grids])
            values[f"{name}_starts"] = ends - [len(grid) for grid in grids]
            self._put(name, grids, int(ends[-1]))
        for name, value in values.items():
            self._put(name, [value], len(value))

    def _put(self, name: str, parts: Sequence[NDArray], length: int) -> None:
        """Write arrays behind one another into a buffer, which is made, or made anew, where it is too short."""
        buffer = self._tensors.get(name)
        if buffer is None or len(buffer) < length:
            like = torch.from_numpy(parts[0])
            spare = length // 8 if self.changes and len(parts) > 1 else 0  # other images may show more that is static
            buffer = torch.empty(length + spare, *like.shape[1:], dtype=like.dtype, device=self._device)
            self._tensors[name] = buffer
            self.version += 1
        start = 0
        for part in parts:
            buffer[start : start + len(part)].copy_(torch.from_numpy(np.ascontiguousarray(part)))
            start += len(part)


def _grids(image: _Loaded) -> tuple[NDArray, NDArray, NDArray]:
    return image.pixels.rgb, image.pixels.labels, image.pixels.features
