"""Batches for training, made ready while the steps before run, from images that need not all fit into memory."""

import time
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from presight_core.pixels import PixelSource
from stages.ray_pool import PixelBatch, RayPool, bytes_of, choose_images, draw_static

if TYPE_CHECKING:
    from stages.training import TileTraining

POOL_BYTES = 3 << 29  # of decoded images: 1.5 GiB; the pool in use and the next one are in memory at once
POOL_STEPS = 250  # a pool that cannot hold all images is drawn anew this often (released code: about 280)


class Feed:
    """Gives the batch of each step. Batches and pools depend on the seed and the step alone."""

    def __init__(self, job: "TileTraining", source: PixelSource, rows: NDArray[np.int64]) -> None:
        """A feed from the given rows of the frames. Raises InputError, here or later, if an image cannot be read."""
        self.waited_s = 0.0  # by the steps, for batches that were not ready
        self._job = job
        self._pools = _Pools(job, source, rows)
        # One thread draws batches, one loads pools, which waits for threads of its own that decode.
        self._drawing = ThreadPoolExecutor(1, "draw")
        self._ahead: dict[int, Future[PixelBatch]] = {}

    def __enter__(self) -> "Feed":
        return self

    def __exit__(self, *_: object) -> None:
        self._drawing.shutdown(cancel_futures=True)
        self._pools.close()

    def batch(self, step: int) -> PixelBatch:
        """The batch of a step; that of the next is drawn meanwhile."""
        started = time.perf_counter()
        ready = self._ahead.pop(step, None) or self._drawing.submit(self._draw, step)
        batch = ready.result()
        self.waited_s += time.perf_counter() - started
        if step + 1 < self._job.settings.training.steps:
            self._ahead = {step + 1: self._drawing.submit(self._draw, step + 1)}
        return batch

    def _draw(self, step: int) -> PixelBatch:
        settings, dynamic = self._job.settings.training, self._job.settings.features.dynamic_classes
        pool, groups = self._pools.at(step)
        random = np.random.default_rng([settings.seed, step])
        return draw_static(pool, settings.batch_rays, groups, random, dynamic, settings.thin_weight)


class _Pools:
    """The pool of each step: all images if they fit into memory, else a random part that changes now and then.

    The next part is loaded while the one before is in use.
    """

    def __init__(self, job: "TileTraining", source: PixelSource, rows: NDArray[np.int64]) -> None:
        self._job, self._source, self._rows = job, source, rows
        centroids = np.array([sub_field.centroid_m for sub_field in job.sub_fields])
        offsets = job.frames.positions[rows][:, None] - centroids[None]
        self._sub_field = np.linalg.norm(offsets, axis=-1).argmin(-1)
        self._capacity = max(1, POOL_BYTES // bytes_of(source.load(int(rows[0]))))
        self._loading = ThreadPoolExecutor(1, "load")
        self._next: dict[int, Future[RayPool]] = {}
        self._epoch = -1

    def close(self) -> None:
        """End the loading."""
        self._loading.shutdown(cancel_futures=True)

    def at(self, step: int) -> tuple[RayPool, list[NDArray[np.int64]]]:
        """The pool of a step, and its images grouped by sub-field."""
        epoch = 0 if self._fits else step // POOL_STEPS
        if epoch != self._epoch:
            loaded = self._next.pop(epoch, None) or self._loading.submit(self._load, epoch)
            self._pool, self._epoch = loaded.result(), epoch
            owner = self._sub_field[self._choose(epoch)]
            self._groups = [np.flatnonzero(owner == sub_field) for sub_field in np.unique(owner)]
            if not self._fits and (epoch + 1) * POOL_STEPS < self._job.settings.training.steps:
                self._next = {epoch + 1: self._loading.submit(self._load, epoch + 1)}
        return self._pool, self._groups

    @property
    def _fits(self) -> bool:
        return len(self._rows) <= self._capacity

    def _load(self, epoch: int) -> RayPool:
        return RayPool(self._job.frames, self._source, self._rows[self._choose(epoch)], self._job.threads)

    def _choose(self, epoch: int) -> NDArray[np.int64]:
        """Places in `rows` of the pool's images."""
        random = np.random.default_rng([self._job.settings.training.seed, epoch, 1])  # 1: apart from the steps'
        return choose_images(self._sub_field, self._capacity, random)
