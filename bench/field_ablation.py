"""What each ingredient of the field is worth: `python -m bench.field_ablation WORKSPACE CITY --at 500,1000`.

One tile of a city that was built in WORKSPACE is trained as a whole and with one ingredient left out at a time.
Held-out figures after the steps of `--at` and at the end; minutes are processor minutes of training. Prints a table,
writes JSON and pictures to bench/out/field_ablation/CITY.
"""

import argparse
import json
from pathlib import Path
from typing import Any

from bench.field_tile import marks_of, open_tile, train
from presight_core.field import threads
from stages.evaluation import evaluate_tile

VARIANTS: dict[str, list[str]] = {
    "whole": [],
    "no proposals": ["field.proposals=[]", "sampling.proposal_samples=[]", "sampling.field_samples=64"],
    "no embeddings": ["field.video_embedding=0", "field.image_embedding=0"],
    "no sky loss": ["training.loss.sky=0.0"],
    "no masks": ["features.dynamic_classes=[]"],
    "no features": ["training.loss.features=0.0"],
    "no floor": ["sampling.floor_m=1000.0"],
    "no ground": ["training.ground.weight=0.0"],
    "no stereo": ["training.stereo.weight=0.0"],
    "no lens falloff": ["field.lens_falloff=false"],
    "no thin weight": ["training.thin_weight=1.0"],
}
COLUMNS = ("steps", "minutes", "psnr_db", "psnr_own_video_db", "feature_rmse", "found_share", "sky_share")


def main() -> None:
    """Train the variants one after another, print, write."""
    options = _options()
    threads.use_threads(options.threads)
    threads.keep_freed_memory()
    out = Path(__file__).parent / "out" / "field_ablation" / options.city
    out.mkdir(parents=True, exist_ok=True)
    print("| variant | " + " | ".join(COLUMNS) + " |")
    print("|---" * (len(COLUMNS) + 1) + "|")
    results: dict[str, list[dict[str, Any]]] = {}
    for name in options.variant or VARIANTS:
        tile = open_tile(options.workspace, options.city, 0, [*options.set, *VARIANTS[name]], options.threads)
        results[name] = []
        for step, minutes, field in train(tile, marks_of(options.at)):
            figures = evaluate_tile(tile.job, field, tile.source, out / name.replace(" ", "-")).metrics
            results[name].append({"steps": step, "minutes": minutes, **figures})
            cells = (f"{results[name][-1].get(column, float('nan')):.4g}" for column in COLUMNS)
            print(f"| {name} | " + " | ".join(cells) + " |", flush=True)
        (out / "results.json").write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("city")
    parser.add_argument("--set", action="append", default=[], help="a setting of all variants, section.name=value")
    parser.add_argument("--variant", action="append", choices=VARIANTS, help="only these")
    parser.add_argument("--at", default="", help="steps at which to look, besides the end")
    parser.add_argument("--threads", type=int, default=1)
    return parser.parse_args()


if __name__ == "__main__":
    main()
