"""May a new build of a tile replace what the city shows?"""

import math
from collections.abc import Mapping

from presight_core.config import ValidationSettings
from presight_core.priors.summary import TileSummary


def validate_tile(
    new: TileSummary, metrics: Mapping[str, float], old: TileSummary | None, settings: ValidationSettings
) -> tuple[str, ...]:
    """What speaks against publishing a new build, a line each; empty if nothing does.

    `metrics` are those of the build, `psnr_db` among them if any frame was held out; `old` is the build shown today.
    """
    problems = []
    if new.voxel_count < settings.min_voxels:
        problems.append(f"{new.voxel_count} voxels, fewer than validation.min_voxels = {settings.min_voxels}")
    broken = sorted(name for name, value in metrics.items() if not math.isfinite(value))
    if broken:
        problems.append(f"not a number: {', '.join(broken)}; the training diverged")
    psnr_db = metrics.get("psnr_db", math.inf)
    if psnr_db < settings.min_psnr_db:
        problems.append(f"held-out PSNR {psnr_db:.1f} dB, below validation.min_psnr_db = {settings.min_psnr_db:g}")
    kept = new.kept_share(old) if old else 1.0
    if kept < settings.min_coverage:
        problems.append(
            f"keeps {kept:.0%} of the observed columns, less than validation.min_coverage = {settings.min_coverage:.0%}"
        )
    return tuple(problems)
