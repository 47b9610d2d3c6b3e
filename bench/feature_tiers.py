"""What the compact cache does to a trained field: the same training on exact and on compact features, several seeds.

    python bench/feature_tiers.py WORKSPACE CITY [--steps 400] [--seeds 2]

The workspace needs the city's drives only (`presight ingest`). All fields are judged by the exact features of held-out
frames. Two seeds of the exact tier say how large a difference is chance.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from flows.plan import city_frames
from presight_core.config import load_city_settings
from presight_core.field.checkpoint import load_field
from stages.evaluation import evaluate_tile
from stages.features import FeatureExtractor, extract_drive
from stages.space_fitting import SpaceImages, fit_space
from stages.tiling import sub_fields
from stages.training import TileTraining, train_tile
from storage.features import FeatureCache
from storage.pixels import CachedPixels
from storage.workspace import Workspace

TIERS = ("exact", "compact")


def main() -> None:
    """Extract once, train for every tier and seed, print a line each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("city")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--seeds", type=int, default=2)
    arguments = parser.parse_args()
    overrides = ["preset=demo", f"training.steps={arguments.steps}"]
    workspace = Workspace.open(arguments.workspace)
    drives = tuple(workspace.catalog().drives(arguments.city))
    settings = load_city_settings(None, overrides)
    frames = city_frames(workspace.drives(), drives, settings)
    roots = {drive.drive_id: drive.root for drive in drives}
    with tempfile.TemporaryDirectory() as folder:
        cache = FeatureCache(Path(folder) / "features")
        channels = _extract(workspace, drives, settings, cache)
        sources = {tier: CachedPixels(frames, roots, cache, tier, settings) for tier in TIERS}
        for seed in range(arguments.seeds):
            chosen = load_city_settings(None, [*overrides, f"training.seed={seed}"])
            job = TileTraining("bench", frames, sub_fields(frames.positions, chosen.tiling), chosen, channels, 1)
            for tier in TIERS:
                started = time.perf_counter()
                scratch = Path(folder) / f"{tier}{seed}"
                result = train_tile(job, sources[tier], scratch)
                field = load_field(result.folder, "cpu")
                figures = evaluate_tile(job, field, sources["exact"], scratch / "pictures").metrics
                shown = "  ".join(f"{name} {value:.4f}" for name, value in sorted(figures.items()))
                print(f"{tier:8} seed {seed}  {shown}  {time.perf_counter() - started:.0f} s", flush=True)


def _extract(workspace, drives, settings, cache: FeatureCache) -> int:
    """Both tiers of all drives, from one pass through the networks; the channels of the space."""
    extractor = FeatureExtractor.load(settings.features)
    tables = {drive.drive_id: workspace.drives().frames(drive.drive_id) for drive in drives}
    space = fit_space(SpaceImages((drive, tables[drive.drive_id]) for drive in drives), extractor, settings.features)
    for drive in drives:
        table = tables[drive.drive_id]
        items = list(extract_drive(drive, table, space, extractor, settings.features))
        cache.write("exact", drive.drive_id, table, items)
        cache.write("compact", drive.drive_id, table, items, space.channel_weights)
        print(
            f"{drive.name}: {len(items)} images,", *(_size(cache, tier, drive.drive_id) for tier in TIERS), flush=True
        )
    rows = [(drive.drive_id, row) for drive in drives for row in range(0, len(tables[drive.drive_id]), 10)]
    _print_error(*(np.stack([cache.read(tier, *row).features for row in rows]).astype(np.float32) for tier in TIERS))
    return space.channel_count


def _size(cache: FeatureCache, tier: str, drive_id: str) -> str:
    return f"{tier} {cache.figures(tier, drive_id)['feature_bytes'] / 1000:.1f} kB an image"


def _print_error(exact: np.ndarray, compact: np.ndarray) -> None:
    mean, deviation = exact.mean((0, 1, 2)), exact.std((0, 1, 2))
    a, b = exact - mean, compact - mean
    cosine = (a * b).sum(-1) / (np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1))
    error = np.sqrt((((a - b) / deviation) ** 2).mean())
    print(f"compact: median centred cosine {np.median(cosine):.4f}, error {error:.3f} of the channels' deviation")


if __name__ == "__main__":
    main()
