"""Frames a second of the perception models with and without a prior, reading and voxelising it included.

Run with `python -m bench.perception_frames STORE CITY [--size tiny] [--device cuda] [--rounds 3]`. Random headings at
random places of mapped blocks. With and without take turns, so that a busy machine harms both alike; medians. On a
processor one thread works. Prints a table, and writes it as JSON to bench/out/.
"""

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from torch import nn

from bench.prior_window import street_poses
from presight_core import frames
from presight_core.priors import PriorReader
from presight_perception.dataset import CityPriors, Place, PriorBatch, PriorDataset, PriorSettings, collate
from presight_perception.models.bev_features import Sources
from presight_perception.models.bevdet_occ import BevDetOcc, BevDetOccSettings
from presight_perception.models.camera_rig import CameraRig
from presight_perception.models.fb_occ import FbOcc, FbOccSettings
from presight_perception.models.map_tr import MapTr, MapTrSettings
from presight_perception.models.raster_mapper import RasterMapper, RasterMapperSettings
from presight_perception.models.stream_map_net import StreamMapNet, StreamMapNetSettings

Result = TypeVar("Result")

CAMERAS = 6
IMAGES = {"paper": {"map": (450, 800), "occupancy": (256, 704)}, "tiny": {"map": (112, 200), "occupancy": (128, 352)}}
MODELS = {
    "RasterMapper": (RasterMapper, RasterMapperSettings, "map"),
    "StreamMapNet": (StreamMapNet, StreamMapNetSettings, "map"),
    "MapTr": (MapTr, MapTrSettings, "map"),
    "BevDetOcc": (BevDetOcc, BevDetOccSettings, "occupancy"),
    "FbOcc": (FbOcc, FbOccSettings, "occupancy"),
}


class Case(NamedTuple):
    """What is measured."""

    model: str
    size: str
    device: torch.device


def main() -> None:
    """Print and write a line for each model."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("store")
    parser.add_argument("city")
    parser.add_argument("--models", nargs="+", default=list(MODELS), choices=list(MODELS))
    parser.add_argument("--size", default="paper", choices=list(IMAGES))
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--rounds", type=int, default=3)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for name in chosen.models:
        case = Case(name, chosen.size, torch.device(chosen.device))
        rows.append(measure(case, chosen.store, chosen.city, chosen.rounds))
        print("  ".join(f"{key} {value:.1f}" if isinstance(value, float) else value for key, value in rows[-1].items()))
    out = Path(__file__).parent / "out" / f"perception_frames_{chosen.size}_{chosen.device}.json"
    out.parent.mkdir(exist_ok=True)
    out.write_text(json.dumps(rows, indent=1), encoding="utf-8")


def measure(case: Case, store: str, city: str, rounds: int) -> dict[str, str | float]:
    """Milliseconds of a frame without and with prior, and of the prior's parts."""
    (model, settings, kind), device = MODELS[case.model], case.device
    priors = CityPriors(store, {city: None})
    sources = Sources(prior_channels=4 + priors.channel_count)
    plain = model(getattr(settings, case.size)(Sources())).eval().to(device)
    fused = model(getattr(settings, case.size)(sources)).eval().to(device)
    grid = fused.bev.settings.grid.prior_grid if kind == "map" else fused.common.prior_grid
    poses = street_poses(PriorReader.open(store, city), rounds + 1)
    samples = PriorDataset(priors, [Place(city, pose) for pose in poses], PriorSettings(grid))
    size = IMAGES[case.size][kind]
    online = _images(size, device), _rig(size).to(device)
    took: dict[str, list[float]] = {"plain": [], "load": [], "fused": []}
    with torch.inference_mode():
        for index in range(rounds + 1):  # the first warms up
            plain_ms, _ = _timed(partial(plain, *online), device)
            load_ms, prior = _timed(partial(_prior, samples, index, device), device)
            fused_ms, _ = _timed(partial(fused, *online, prior), device)
            for part, value in (("plain", plain_ms), ("load", load_ms), ("fused", fused_ms)):
                took[part].append(value)
    plain_ms, load_ms, fused_ms = (float(np.median(took[part][1:])) for part in ("plain", "load", "fused"))
    return {
        "model": case.model,
        "without_ms": plain_ms,
        "read_and_voxelise_ms": load_ms,
        "fusion_ms": fused_ms - plain_ms,
        "overhead_percent": 100 * (load_ms + fused_ms - plain_ms) / plain_ms,
        "parameters_m": _parameters(plain) / 1e6,
        "parameters_with_prior_m": _parameters(fused) / 1e6,
    }


def _images(size: tuple[int, int], device: torch.device) -> torch.Tensor:
    return torch.rand(1, CAMERAS, 3, *size, generator=torch.Generator().manual_seed(0)).to(device)


def _rig(size: tuple[int, int]) -> CameraRig:
    """Six cameras around, 1.5 m above the ground."""
    height, width = size
    intrinsics = torch.tensor([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1.0]])
    forward = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])
    turns = [frames.planar_transform(0.0, 0.0, angle) for angle in np.arange(CAMERAS) * 2 * np.pi / CAMERAS]
    ego_from_camera = torch.from_numpy(np.stack(turns) @ forward).float()
    return CameraRig(intrinsics.expand(1, CAMERAS, 3, 3), ego_from_camera[None])


def _parameters(model: nn.Module) -> int:
    return sum(parameter.numel() for parameter in model.parameters())


def _prior(samples: PriorDataset, index: int, device: torch.device) -> PriorBatch:
    return PriorBatch(*(part.to(device) for part in collate([samples[index]])))


def _timed(run: Callable[[], Result], device: torch.device) -> tuple[float, Result]:
    """Milliseconds of processor time, or on a GPU of the wall's, which then is what counts; and what came out."""
    clock = time.perf_counter if device.type == "cuda" else time.process_time
    if device.type == "cuda":
        torch.cuda.synchronize()
    start = clock()
    result = run()
    if device.type == "cuda":
        torch.cuda.synchronize()
    return (clock() - start) * 1e3, result


if __name__ == "__main__":
    main()
