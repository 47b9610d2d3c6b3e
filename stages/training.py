"""Training: one tile's field, from the pixels of its frames."""

import hashlib
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from presight_core import classes
from presight_core.config import CitySettings, TrainingSettings
from presight_core.drives import FrameTable
from presight_core.errors import BuildError, InputError, NotFoundError
from presight_core.field import checkpoint, losses, schedule, threads
from presight_core.field.rays import Rays
from presight_core.field.tile_field import FieldShape, Rendering, Sampling, TileField
from presight_core.pixels import PixelSource
from presight_core.progress import Progress, Report, silent
from presight_core.recipes import Recipe
from presight_core.tiles import SubField
from stages import versions
from stages.card_pool import Targets
from stages.feeding import Feed
from stages.ground import Ground
from stages.ray_pool import PixelBatch
from stages.stereo import Images, KnownDepths, plane_maps
from stages.warm_start import FieldStart, go_on_from

REPORT_SECONDS = 0.5
HINT_WEIGHT = 0.2  # of known depths: two or three of 16 samples lie at each
PULSE_WIDTHS = (0.03, 0.003)  # of the blurred interlevel loss, coarse proposal first (released code)


Advance = Callable[[int], tuple[dict[str, Tensor], float]]  # does a step; its losses, and seconds waited so far


@dataclass(frozen=True)
class TileTraining:
    """What one tile's training needs beside the pixels. `frames` are all frames of the tile, held-out ones too."""

    tile_id: str
    frames: FrameTable
    sub_fields: tuple[SubField, ...]
    settings: CitySettings
    feature_channels: int
    threads: int = 1
    device: str = "cpu"
    start: FieldStart | None = None  # a field of the same sub-fields to go on from; None: random numbers

    @property
    def recipe(self) -> Recipe:
        """Everything that decides the trained field, pixels aside."""
        frames, chosen = self.frames, ("field", "sampling", "training")
        digest = hashlib.sha256()
        for column in (frames.drive_id, frames.path, frames.intrinsics, frames.world_from_camera):
            digest.update(np.ascontiguousarray(column).tobytes())
        inputs = {
            "frames": digest.hexdigest(),
            "sub_fields": [sub_field.to_json() for sub_field in self.sub_fields],
            "feature_channels": self.feature_channels,
            "dynamic_classes": list(self.settings.features.dynamic_classes),
        }
        if self.start:
            inputs["start"] = self.start.name
        settings = {name: getattr(self.settings, name).model_dump(mode="json") for name in chosen}
        return Recipe("training", versions.TRAINING, settings, inputs)


@dataclass(frozen=True)
class TrainingResult:
    """Where the field lies (see `load_field`), and figures of the end of training.

    loss, psnr_db, rays_per_s, and waiting_share: of the time, how much was spent waiting for batches.
    """

    folder: Path
    metrics: dict[str, float]


def train_tile(job: TileTraining, source: PixelSource, scratch: Path, report: Report = silent) -> TrainingResult:
    """Train one tile's field; resumes from `scratch` where its checkpoint has the same recipe.

    Random numbers depend on the seed and the step alone, so an interrupted training ends as an
    uninterrupted one would. Raises InputError if there is nothing to train on or an image cannot be
    read, BuildError if the loss stops being a number.
    """
    from stages import card_training

    threads.use_threads(job.threads)
    threads.keep_freed_memory()
    rows = training_rows(job.frames, job.settings.training)
    if not len(rows):
        raise InputError(f"tile {job.tile_id}: none of its {len(job.frames)} frames is for training; ingest more")
    depths = known_depths(job, source, rows, scratch, report)
    if card_training.suits(job):
        run = card_training.CardRun(job, scratch, source, rows, depths=depths)
    else:
        run = Run(job, scratch, depths)
    if run.step < job.settings.training.steps:
        report(Progress("training", run.step, job.settings.training.steps))
        with _steps(job, run, source, rows) as advance, _Log(job, scratch, report) as log:
            _train(job, run, advance, log)
    checkpoint.save_field(scratch / "field", run.field)
    return TrainingResult(scratch / "field", run.metrics)


def known_depths(
    job: TileTraining, source: PixelSource, rows: NDArray[np.int64], scratch: Path, report: Report = silent
) -> KnownDepths | None:
    """What neighbouring images tell of the depths in the images of these rows; None if that is not wanted.

    It is kept in `scratch`, so that a training that goes on need not look again.
    """
    width_px = job.settings.training.stereo.width_px
    if not job.settings.training.stereo.weight:
        return None
    scratch.mkdir(parents=True, exist_ok=True)
    images = Images(job.frames, rows, source)
    maps = plane_maps(images, width_px, scratch / f"stereo-{job.recipe.digest}.npy", report)
    return KnownDepths(maps, job.frames.select(rows), width_px, job.device)


@contextmanager
def _steps(job: TileTraining, run: "Run", source: PixelSource, rows: NDArray[np.int64]) -> Iterator[Advance]:
    """What takes a run one step further: a card draws its own rays, else a feed gives them."""
    from stages.card_training import CardRun

    if isinstance(run, CardRun):
        with closing(run):
            yield lambda step: (run.advance(step), 0.0)
    else:
        with Feed(job, source, rows) as feed:
            yield lambda step: (run.train(step, feed.batch(step)), feed.waited_s)


def _train(job: TileTraining, run: "Run", advance: Advance, log: "_Log") -> None:
    """All steps that are left."""
    settings = job.settings.training
    for step in range(run.step, settings.steps):
        log.add(step, *advance(step))
        if (step + 1) % settings.checkpoint_every == 0 or step + 1 == settings.steps:
            log.flush(step)
            run.save(step + 1, log.figures)


def training_rows(frames: FrameTable, settings: TrainingSettings) -> NDArray[np.int64]:
    """Rows that a tile trains on."""
    rows, held_out = _split(frames, settings)
    return rows[~held_out]


def holdout_rows(frames: FrameTable, settings: TrainingSettings) -> NDArray[np.int64]:
    """Rows that a tile is evaluated on."""
    rows, held_out = _split(frames, settings)
    return rows[held_out]


def holdout_mask(frames: FrameTable, every: int) -> NDArray[np.bool_]:
    """Which frames are held out: every `every`-th of each camera of each drive, from the middle of each stretch.

    From the middle, so that neighbours on both sides are trained on. 0 holds nothing out.
    """
    mask = np.zeros(len(frames), np.bool_)
    if not every:
        return mask
    lenses = lens_numbers(frames)
    for lens in np.unique(lenses):
        rows = np.flatnonzero(lenses == lens)
        rows = rows[np.argsort(frames.timestamp_us[rows], kind="stable")]
        mask[rows[every // 2 :: every]] = True
    return mask


def video_numbers(frames: FrameTable) -> NDArray[np.int64]:
    """The number of each frame's video (drive) in the field's embedding."""
    return np.unique(frames.drive_id, return_inverse=True)[1].astype(np.int64)


def lens_numbers(frames: FrameTable) -> NDArray[np.int64]:
    """The number of the camera of each frame, in the field: those of different drives are different ones."""
    names = np.char.add(np.char.add(frames.drive_id, "\n"), frames.camera)
    return np.unique(names, return_inverse=True)[1].astype(np.int64)


def image_numbers(frames: FrameTable, settings: TrainingSettings) -> NDArray[np.int64]:
    """The number of each trained frame in the field's embedding, -1 of the others.

    Frames that are not trained on have none: their random rows would spoil the mean that evaluation uses.
    """
    numbers = np.full(len(frames), -1, np.int64)
    rows = training_rows(frames, settings)
    numbers[rows] = np.arange(len(rows))
    return numbers


def _split(frames: FrameTable, settings: TrainingSettings) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The rows in use, and which of them are held out."""
    rows = np.flatnonzero(frames.is_keyframe) if settings.keyframes_only else np.arange(len(frames))
    return rows, holdout_mask(frames.select(rows), settings.holdout_every)


class Run:
    """A field in training: its parameters, its optimiser, and their checkpoint."""

    def __init__(self, job: TileTraining, scratch: Path, depths: KnownDepths | None = None) -> None:
        self.step, self.metrics = 0, {}
        self._depths = depths
        self._job, self._settings = job, job.settings.training
        self._file = scratch / "training.safetensors"
        self._videos, self._images = video_numbers(job.frames), image_numbers(job.frames, self._settings)
        self._lenses = lens_numbers(job.frames)
        self.field = _new_field(job, *(int(each.max()) + 1 for each in (self._videos, self._images, self._lenses)))
        if job.start:
            go_on_from(job.start, self.field, job.frames, self._images, self._lenses)
        self._names = {id(parameter): name for name, parameter in self.field.named_parameters()}
        is_table = {id(parameter): name.endswith("grid.table") for name, parameter in self.field.named_parameters()}
        tables = [parameter for parameter in self.field.parameters() if is_table[id(parameter)]]
        others = [parameter for parameter in self.field.parameters() if not is_table[id(parameter)]]
        groups = [{"params": tables, "weight_decay": 0.0}, {"params": others}]
        # 1e-15 (Instant-NGP): a hash row's gradients are tiny and rare, the usual 1e-8 would swallow them.
        betas, decay = (0.9, self._settings.beta2), self._settings.weight_decay
        self._optimiser = torch.optim.AdamW(groups, betas=betas, weight_decay=decay, eps=1e-15, fused=True)
        self._generator = torch.Generator(job.device)
        ground = self._settings.ground
        self._ground = Ground(job.frames.positions, ground) if ground.weight else None
        self._resume()

    def train(self, step: int, batch: PixelBatch) -> dict[str, Tensor]:
        """One step of the optimiser; its losses by name."""
        for group in self._optimiser.param_groups:
            group["lr"] = schedule.learning_rate(step, self._settings)
        jitter = self._random(step, len(batch.rows), self.passes)
        exponent, trains_proposals = self._schedule(step)
        stereo_share = schedule.stereo_share(step, self._settings)
        targets = Targets(
            *(torch.from_numpy(values).to(self._job.device) for values in (batch.rgb, batch.labels, batch.features))
        )
        sampling = Sampling(
            jitter,
            exponent,
            trains_proposals,
            fade_m=self._settings.fade_m,
            features_shape=self._settings.features_shape,
        )
        if self._ground is None:
            return self._descend(self._rays(batch), targets, sampling, stereo_share)
        start_m, end_m = (torch.from_numpy(value).to(self._job.device) for value in self._ground.stretches(batch))
        return self._descend(replace(self._rays(batch), ends_m=end_m), targets, sampling, stereo_share, start_m)

    @property
    def passes(self) -> int:
        """How often samples are placed along a ray."""
        return len(self._job.settings.sampling.proposal_samples) + 1

    def _random(self, step: int, *size: int) -> Tensor:
        """Uniform random numbers of a step."""
        # Torch's seed must depend on both: consecutive seeds of the same run never meet those of another.
        self._generator.manual_seed(self._settings.seed << 32 | step)
        return torch.rand(*size, generator=self._generator, device=self._job.device)

    def _schedule(self, step: int) -> tuple[float, bool]:
        """The exponent of the proposals' weights, and whether the proposals learn."""
        return schedule.anneal_exponent(step, self._settings), schedule.trains_proposals(step, self._settings)

    def _descend(
        self,
        rays: Rays,
        targets: Targets,
        sampling: Sampling,
        stereo_share: float | Tensor,
        starts_m: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """One step of the optimiser; its losses by name. On a card nothing here may wait for it: see CardRun.

        Where rays show the ground they must not end before `starts_m` (R,), metres; 0: nothing is known.
        """
        if self._depths is not None:
            known_m = self._depths.along(rays, targets.labels)
            sampling = replace(sampling, hints_m=known_m, hint_weight=HINT_WEIGHT * stereo_share)
        rendering = self.field(rays, sampling)
        parts = self._losses(rendering, targets, sampling.train_proposals)
        if starts_m is not None:
            middles_m = (rendering.edges_m[:, 1:] + rendering.edges_m[:, :-1]) / 2
            ground = losses.ground_loss(rendering.field.weights, middles_m, starts_m)
            parts["ground"] = self._settings.ground.weight * ground
        if sampling.hints_m is not None:
            known = sampling.hints_m[:, 0], self._settings.stereo.tolerance
            loss = losses.stereo_loss(rendering.field.weights, rendering.edges_m, *known)
            parts["stereo"] = self._settings.stereo.weight * stereo_share * loss
        torch.stack(list(parts.values())).sum().backward()
        self._optimiser.step()
        self._optimiser.zero_grad()
        self.field.refresh_copies()
        return {name: part.detach() for name, part in parts.items()}

    def save(self, step: int, figures: dict[str, float]) -> None:
        """Make the state after `step` steps durable."""
        self.step, self.metrics = step, figures
        tensors = {f"field/{name}": tensor for name, tensor in self.field.state_dict().items()}
        tensors |= {
            f"{quantity}/{self._names[id(parameter)]}": tensor
            for parameter, state in self._optimiser.state.items()
            for quantity, tensor in state.items()
        }
        header = {"recipe": self._job.recipe.digest, "step": step, "metrics": figures}
        checkpoint.save_tensors(self._file, tensors, header)

    def _resume(self) -> None:
        try:
            tensors, header = checkpoint.load_tensors(self._file, self._job.device)
        except (NotFoundError, InputError):  # none yet, or unreadable: start over
            return
        if header["recipe"] != self._job.recipe.digest:
            return
        self.step, self.metrics = header["step"], header["metrics"]
        state: dict[str, dict[str, Tensor]] = {}
        for key, tensor in tensors.items():
            quantity, name = key.split("/", 1)
            state.setdefault(quantity, {})[name] = tensor
        self.field.load_state_dict(state.pop("field"))
        for name, parameter in self.field.named_parameters():
            self._optimiser.state[parameter] = {quantity: values[name] for quantity, values in state.items()}

    def _rays(self, batch: PixelBatch) -> Rays:
        numbers = (each[batch.rows] for each in (self._videos, self._images, self._lenses))
        return self.field.rays(batch.origins_world, batch.directions_world, *numbers, off_centre=batch.off_centre)

    def _losses(self, rendering: Rendering, targets: Targets, trains_proposals: bool) -> dict[str, Tensor]:
        """The five losses (paper, section 3.2), weighted."""
        weights, labels = self._settings.loss, targets.labels
        sky = losses.sky_loss(rendering.accumulation, labels == classes.SKY, labels != classes.UNKNOWN)
        parts = {
            "rgb": functional.mse_loss(rendering.rgb, targets.rgb / 255),
            "features": weights.features * losses.feature_loss(rendering.features, targets.features / 255),
            "sky": weights.sky * sky,
            "distortion": weights.distortion * losses.distortion_loss(rendering.field.edges, rendering.field.weights),
        }
        if trains_proposals and rendering.proposals:
            parts["interlevel"] = weights.interlevel * _interlevel(rendering)
        return parts


def _new_field(job: TileTraining, video_count: int, image_count: int, lens_count: int) -> TileField:
    """A field with random parameters that depend on the seed alone."""
    settings = job.settings
    counts = (job.feature_channels, video_count, image_count, lens_count)
    shape = FieldShape(job.sub_fields, settings.field, settings.sampling, *counts)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.training.seed)
        field = TileField(shape).to(job.device)
    if settings.training.bfloat16 and threads.has_fast_bfloat16(job.device):
        field.use_dtype(torch.bfloat16)
    return field


def _interlevel(rendering: Rendering) -> Tensor:
    field = rendering.field
    parts = [
        losses.blurred_interlevel_loss(field.edges, field.weights, proposal.edges, proposal.weights, width)
        for proposal, width in zip(rendering.proposals, PULSE_WIDTHS, strict=False)
    ]
    return torch.stack(parts).sum()


class _Log:
    """Losses of the latest steps, on their way to the caller and to TensorBoard."""

    def __init__(self, job: TileTraining, scratch: Path, report: Report) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self.figures: dict[str, float] = {}
        self._job, self._report = job, report
        self._writer = SummaryWriter(scratch / "tensorboard")
        self._sums: dict[str, Tensor] = {}
        self._steps = 0
        self._waited_s = self._waited_before_s = 0.0  # for batches, in all; up to the last report
        self._started = time.perf_counter()

    def __enter__(self) -> "_Log":
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def add(self, step: int, parts: dict[str, Tensor], waited_s: float) -> None:
        """Note a step's losses, and how long all steps waited for batches; every half second they are reported."""
        self._waited_s = waited_s
        for name, part in parts.items():
            self._sums[name] = self._sums.get(name, torch.zeros_like(part)) + part
        self._steps += 1
        if time.perf_counter() - self._started > REPORT_SECONDS:
            self.flush(step)

    def flush(self, step: int) -> None:
        """Report the mean of the steps since the last report. Raises BuildError if it is not a number."""
        if not self._steps:
            return
        seconds = time.perf_counter() - self._started
        means = {name: float(total) / self._steps for name, total in self._sums.items()}
        loss = sum(means.values())
        if not np.isfinite(loss):
            rate = self._job.settings.training.learning_rate
            raise BuildError(
                f"tile {self._job.tile_id}: the loss is {loss} at step {step}; lower training.learning_rate ({rate})"
            )
        rays_per_s = self._steps * self._job.settings.training.batch_rays / seconds
        self.figures = {
            "loss": loss,
            "psnr_db": -10 * float(np.log10(means["rgb"])),
            "rays_per_s": rays_per_s,
            "waiting_share": (self._waited_s - self._waited_before_s) / seconds,
        }
        self._waited_before_s = self._waited_s
        for name, value in {**{f"loss/{name}": mean for name, mean in means.items()}, **self.figures}.items():
            self._writer.add_scalar(name, value, step + 1)
        self._report(Progress("training", step + 1, self._job.settings.training.steps, dict(self.figures)))
        self._sums, self._steps, self._started = {}, 0, time.perf_counter()
