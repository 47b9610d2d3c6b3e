"""Training on a card: the whole step is one CUDA graph, from drawing rays to the new parameters.

Launching a step's few hundred kernels one by one would take the host as long as the card takes to run them. A
graph is launched at once, but repeats exactly what was recorded: shapes and addresses may not change, and
nothing may wait for a value. What changes with the step (random numbers, learning rate, annealing) therefore
lies in tensors that are written before each replay.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from presight_core.field import schedule, threads
from presight_core.field.tile_field import Sampling
from presight_core.pixels import PixelSource
from stages.card_ground import CardGround
from stages.card_pool import CardPool, Choice, PoolFrames
from stages.feeding import POOL_STEPS
from stages.stereo import KnownDepths
from stages.training import Run, TileTraining

EAGER_STEPS = 3  # of each kind before it is recorded: kernels get compiled, and the optimiser's state made
DRAWS = 2  # random numbers that choose a ray: which image, which pixel

Losses = dict[str, Tensor]


class CardRun(Run):
    """A run that draws its own rays and replays its steps. Raises InputError if an image cannot be read.

    Works without a card too, one operation after the other, so that its parts can be tested.
    """

    def __init__(
        self,
        job: TileTraining,
        scratch: Path,
        source: PixelSource,
        rows: NDArray[np.int64],
        replays: bool = True,
        depths: KnownDepths | None = None,
    ) -> None:
        super().__init__(job, scratch, depths)
        choice = Choice(job.settings.features.dynamic_classes, self._settings.thin_weight, self._settings.seed)
        self.pool = CardPool(self._pool_frames(rows), source, choice, job.device, job.threads)
        positions, ground = job.frames.positions, self._settings.ground
        origin_m = self.field.origin_m
        self._card_ground = CardGround(positions, origin_m, ground, job.device) if ground.weight else None
        size = (self._settings.batch_rays, DRAWS + self.passes)
        self._noise = torch.empty(size, device=job.device)
        self._anneal, self._rate = torch.ones((), device=job.device), torch.zeros((), device=job.device)
        self._stereo_share = torch.zeros((), device=job.device)
        for group in self._optimiser.param_groups:
            group |= {"lr": self._rate, "capturable": True}
        self._replays = replays and job.device.startswith("cuda")
        self._version = 0
        self._recordings: dict[bool, Recording] = {}

    def advance(self, step: int) -> Losses:
        """One step of the optimiser; its losses by name, which the next step overwrites."""
        self.pool.show(step // POOL_STEPS)
        if self._version != self.pool.version:  # buffers have moved: what was recorded would read the old ones
            self._version = self.pool.version
            self._recordings = self._new_recordings()
        exponent, trains_proposals = self._schedule(step)
        self._rate.fill_(schedule.learning_rate(step, self._settings))
        self._anneal.fill_(exponent)
        self._stereo_share.fill_(schedule.stereo_share(step, self._settings))
        self._noise.copy_(self._random(step, *self._noise.shape))
        return self._recordings[trains_proposals]() if self._replays else self._body(trains_proposals)

    def close(self) -> None:
        """Stop decoding images."""
        self.pool.close()

    def _new_recordings(self) -> dict[bool, "Recording"]:
        """A recording of steps that train the proposals, and one of those that do not; they never run at once."""
        if not self._replays:
            return {}
        memory, stream = torch.cuda.graph_pool_handle(), torch.cuda.Stream(self._job.device)
        return {kind: Recording(lambda kind=kind: self._body(kind), memory, stream) for kind in (True, False)}

    def _body(self, trains_proposals: bool) -> Losses:
        draws, jitter = self._noise.split([DRAWS, self.passes], -1)
        rays, targets = self.pool.draw(draws)
        sampling = Sampling(
            jitter,
            self._anneal,
            trains_proposals,
            fade_m=self._settings.fade_m,
            features_shape=self._settings.features_shape,
        )
        if self._card_ground is None:
            return self._descend(rays, targets, sampling, self._stereo_share)
        start_m, end_m = self._card_ground.stretches(rays, targets.labels)
        return self._descend(replace(rays, ends_m=end_m), targets, sampling, self._stereo_share, start_m)

    def _pool_frames(self, rows: NDArray[np.int64]) -> PoolFrames:
        frames = self._job.frames.select(rows)
        centroids = np.array([sub_field.centroid_m for sub_field in self._job.sub_fields])
        world_from_pixel = frames.world_from_camera[:, :3, :3] @ np.linalg.inv(frames.intrinsics)
        distances = np.linalg.norm(frames.positions[:, None] - centroids[None], axis=-1)
        return PoolFrames(
            rows=rows,
            origins=(frames.positions - self.field.origin_m).astype(np.float32),
            world_from_pixel=world_from_pixel.astype(np.float32),
            sizes_px=np.stack([frames.width_px, frames.height_px], -1).astype(np.int64),
            videos=self._videos[rows],
            images=self._images[rows],
            lenses=self._lenses[rows],
            sub_fields=distances.argmin(-1),
        )


class Recording:
    """A function that works on tensors at fixed places: a few calls run it, the next records it, others replay it."""

    def __init__(self, function: Callable[[], Losses], memory: Any, stream: torch.cuda.Stream) -> None:
        """Recordings that share `memory` must not run at the same time."""
        self._function, self._memory, self._stream = function, memory, stream
        self._calls = 0
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self) -> Losses:
        """The function's result; that of a replay lies where it lay the last time."""
        if self._graph is not None:
            self._graph.replay()
            return self._result
        self._calls += 1
        return self._run() if self._calls <= EAGER_STEPS else self._record()

    def _run(self) -> Losses:
        """Run the function on the stream that it will be recorded from."""
        present = torch.cuda.current_stream(self._stream.device)
        self._stream.wait_stream(present)
        with torch.cuda.stream(self._stream):
            result = self._function()
        present.wait_stream(self._stream)
        return result

    def _record(self) -> Losses:
        graph = torch.cuda.CUDAGraph()
        # thread_local: threads that decode images may do as they like meanwhile.
        with torch.cuda.graph(graph, self._memory, self._stream, capture_error_mode="thread_local"):
            self._result = self._function()
        self._graph = graph
        return self()


def suits(job: TileTraining) -> bool:
    """Whether a tile's steps can be recorded: on a card whose matrix units take bfloat16, and if that is wanted."""
    on_card = job.device.startswith("cuda")
    return on_card and job.settings.training.bfloat16 and threads.has_fast_bfloat16(job.device)
