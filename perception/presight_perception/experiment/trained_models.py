"""Models by their runs: trained once, kept in a folder named by all that decides them, so that tables share them."""

from dataclasses import replace
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file
from torch import nn

from presight_core.progress import Report
from presight_perception.dataset import PositionNoise
from presight_perception.experiment.line_training import LineTraining
from presight_perception.experiment.material import Material
from presight_perception.experiment.runs import Run, digest
from presight_perception.experiment.tasks import MODELS, Task
from presight_perception.experiment.training import Training, write_whole
from presight_perception.models.bev_features import Sources
from presight_perception.models.nmp_raster_mapper import NmpRasterMapper
from presight_perception.models.raster_mapper import RasterMapperSettings
from presight_perception.voxelise import VoxelDrop

CODE = 2  # raise it when the same run would give another model


def run_folder(run: Run, material: Material, runs: Path) -> Path:
    """Where a run is kept: named by all that decides it."""
    if run.prior == "none":  # then it does not matter what would be hidden of one
        run = replace(run, drop=VoxelDrop(), noise=PositionNoise())
    named = digest(CODE, run, material.digest, material.prior_digest(run.prior))
    return runs / f"{run.model}-{run.prior}-{run.seed}-{named}"


def build_model(run: Run, material: Material) -> nn.Module:
    """The untrained model of a run, the same one for the same seed."""
    torch.manual_seed(run.seed)
    if run.prior == "nmp":
        return NmpRasterMapper(RasterMapperSettings.tiny())
    return MODELS[run.model](Sources(run.cameras, material.voxel_channels(run.prior)))


def trained_model(run: Run, task: Task, material: Material, runs: Path, report: Report) -> nn.Module:
    """The model of a run, from its folder in `runs` if it was trained before, else trained and kept there.

    A run's teacher is trained first, if need be.
    """
    folder = run_folder(run, material, runs)
    weights = folder / "weights.safetensors"
    if not weights.exists():
        teacher = None if run.teacher is None else trained_model(run.teacher, task, material, runs, report)
        model = build_model(run, material)
        folder.mkdir(parents=True, exist_ok=True)
        checkpoint = folder / "checkpoint.safetensors"
        if teacher is None:
            Training(run, task, material, model, checkpoint).go(report)
        else:
            LineTraining(run, task, material, model, checkpoint, teacher).go(report)
        write_whole(weights, lambda file: save_file(model.state_dict(), file))
        checkpoint.unlink(missing_ok=True)
    model = build_model(run, material)
    model.load_state_dict(load_file(weights))
    return model.eval()
