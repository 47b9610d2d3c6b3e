"""The steps of a training, going on where an interrupted one stopped."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from presight_core.progress import Progress, Report
from presight_perception.dataset import collate
from presight_perception.experiment.map_memory import MapMemory
from presight_perception.experiment.material import Material
from presight_perception.experiment.runs import Run, Schedule
from presight_perception.experiment.tasks import Task
from presight_perception.models.nmp_raster_mapper import NmpRasterMapper

CHECKPOINT_STEPS = 100  # a minute or two of work at most is done again
REPORT_STEPS = 10
GRADIENT_NORM = 35.0  # greatest; as in the released configurations
WARM_UP = 0.15  # of the steps


class Training:
    """The steps of one run. Progress is kept every now and then, and gone on from."""

    def __init__(self, run: Run, task: Task, material: Material, model: nn.Module, checkpoint: Path) -> None:
        self._run, self._task, self._material, self._model = run, task, material, model
        self._checkpoint = checkpoint
        schedule = run.schedule
        self._optimizer = torch.optim.AdamW(
            [each for each in model.parameters() if each.requires_grad],
            schedule.learning_rate,
            weight_decay=schedule.weight_decay,
        )
        self._rate = torch.optim.lr_scheduler.OneCycleLR(
            self._optimizer, schedule.learning_rate, total_steps=schedule.steps, pct_start=WARM_UP
        )
        self._prior = material.training_prior(run, task.prior_grid)
        self._memory = MapMemory(model) if isinstance(model, NmpRasterMapper) else None

    def go(self, report: Report) -> None:
        """All steps that are left."""
        losses: list[float] = []
        self._prepare(report)
        for step in range(self._resume(), self._run.schedule.steps):
            epoch = epoch_of(self._run.schedule, len(self._material.train), step)
            if self._prior is not None:
                self._prior.set_epoch(epoch)  # or every epoch would hide the same
            if self._memory is not None and epoch > epoch_of(self._run.schedule, len(self._material.train), step - 1):
                self._memory.clear()
            losses.append(self._step(batch_rows(self._run.schedule, self._run.seed, len(self._material.train), step)))
            done = step + 1
            if done % REPORT_STEPS == 0 or done == self._run.schedule.steps:
                figures = {"loss": float(np.mean(losses[-5 * REPORT_STEPS :]))}
                report(Progress(self._run.title, done, self._run.schedule.steps, figures))
            if done % CHECKPOINT_STEPS == 0:
                self._keep(done)

    def _prepare(self, report: Report) -> None:
        self._model.train()

    def _step(self, rows: list[int]) -> float:
        loss = torch.stack(list(self._losses(rows).values())).sum()
        self._optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self._model.parameters(), GRADIENT_NORM)
        self._optimizer.step()
        self._rate.step()
        return loss.item()

    def _losses(self, rows: list[int]) -> dict[str, Tensor]:
        truths = [self._task.truth(self._model, self._material.train[row]) for row in rows]
        return self._model.loss(self._predictions(rows), truths)  # pyright: ignore[reportCallIssue]

    def _predictions(self, rows: list[int]) -> Any:
        keyframes = [self._material.train[row] for row in rows]
        images, rig = self._material.online(keyframes) if self._run.cameras else (None, None)
        if self._memory is not None and images is not None and rig is not None:
            return self._memory.predict(images, rig, keyframes, remember=True)
        prior = collate([self._prior[row] for row in rows]) if self._prior is not None else None
        more = self._task.more_inputs(keyframes, self._material) if images is not None else {}
        return self._model(images, rig, prior, **more)

    def _resume(self) -> int:
        """The step to go on with."""
        if not self._checkpoint.exists():
            return 0
        with safe_open(self._checkpoint, "pt") as kept:
            facts = json.loads(kept.metadata()["facts"])
            tensors = {name: kept.get_tensor(name) for name in kept.keys()}  # noqa: SIM118 - no mapping
        self._model.load_state_dict(_below("model.", tensors))
        state: dict[int, dict[str, Tensor]] = {}
        for name, value in _below("optimizer.", tensors).items():
            row, _, field = name.partition(".")
            state.setdefault(int(row), {})[field] = value
        self._optimizer.load_state_dict({"state": state, "param_groups": facts["groups"]})
        self._rate.load_state_dict(facts["rate"])
        torch.set_rng_state(tensors["random"])
        return facts["step"]

    def _keep(self, step: int) -> None:
        optimizer = self._optimizer.state_dict()
        tensors = {f"model.{name}": value for name, value in self._model.state_dict().items()}
        for row, values in optimizer["state"].items():
            tensors |= {f"optimizer.{row}.{name}": value for name, value in values.items()}
        tensors["random"] = torch.get_rng_state()
        facts = {"step": step, "groups": optimizer["param_groups"], "rate": self._rate.state_dict()}
        contiguous = {name: value.contiguous() for name, value in tensors.items()}
        write_whole(self._checkpoint, lambda file: save_file(contiguous, file, {"facts": json.dumps(facts)}))


def _below(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def batch_rows(schedule: Schedule, seed: int, count: int, step: int) -> list[int]:
    """The samples of one step: every epoch is another order of all, and no step depends on an earlier one."""
    first = step * schedule.batch_size
    rows = []
    for place in range(first, first + schedule.batch_size):
        epoch, rank = divmod(place, count)
        rows.append(int(np.random.default_rng([seed, epoch]).permutation(count)[rank]))
    return rows


def epoch_of(schedule: Schedule, count: int, step: int) -> int:
    """The epoch that a step begins in, of `count` samples."""
    return max(step, 0) * schedule.batch_size // count


def write_whole(file: Path, write: Callable[[Path], object]) -> None:
    """Write a file such that it is there whole or not at all."""
    part = file.with_suffix(".part")
    write(part)
    part.replace(file)
