"""May a new build of a tile replace what the city shows?"""

import math
from collections.abc import Mapping

from presight_core.config import ValidationSettings
from presight_core.priors.agreement import Agreement


def judge_build(voxel_count: int, metrics: Mapping[str, float], settings: ValidationSettings) -> tuple[str, ...]:
    """What speaks against publishing a build by itself, a line each; empty if nothing does.

    `metrics` are those of the build, `psnr_db` among them if any frame was held out.
    """
    problems = []
    if voxel_count < settings.min_voxels:
        problems.append(
            f"{voxel_count} voxels, fewer than validation.min_voxels = {settings.min_voxels}; a field of few steps is "
            f"thin: raise training.steps, or lower extraction.fog_density and set extraction.surface to first-hit"
        )
    broken = sorted(name for name, value in metrics.items() if not math.isfinite(value))
    if broken:
        problems.append(f"not a number: {', '.join(broken)}; the training diverged")
    psnr_db = metrics.get("psnr_db", math.inf)
    if psnr_db < settings.min_psnr_db:
        problems.append(f"held-out PSNR {psnr_db:.1f} dB, below validation.min_psnr_db = {settings.min_psnr_db:g}")
    return tuple(problems)


def judge_change(
    agreement: Agreement | None, psnr_change_db: float | None, settings: ValidationSettings
) -> tuple[str, ...]:
    """What speaks against replacing the old build by the new one, a line each; empty if nothing does.

    None: there is nothing to compare. `psnr_change_db` is positive where the new build is better.
    """
    problems = []
    if agreement:
        found, cosine = (agreement.old_found, agreement.new_found), agreement.feature_cosine
        if agreement.coverage < settings.min_coverage:
            problems.append(
                f"keeps {agreement.coverage:.0%} of the observed columns, "
                f"less than validation.min_coverage = {settings.min_coverage:.0%}"
            )
        if min(found) < settings.min_geometry:
            problems.append(
                f"{found[0]:.0%} of the old voxels and {found[1]:.0%} of the new ones lie within a voxel of the other "
                f"build's, not validation.min_geometry = {settings.min_geometry:.0%} of both"
            )
        if cosine < settings.min_feature_cosine:
            problems.append(
                f"cosine of old and new features {cosine:.2f}, "
                f"below validation.min_feature_cosine = {settings.min_feature_cosine:g}"
            )
    if psnr_change_db is not None and psnr_change_db < -settings.max_psnr_loss_db:
        problems.append(
            f"held-out PSNR of the drives of before {-psnr_change_db:.1f} dB worse, "
            f"more than validation.max_psnr_loss_db = {settings.max_psnr_loss_db:g}"
        )
    return tuple(problems)


def psnr_change_db(old: Mapping[str, float], new: Mapping[str, float]) -> float | None:
    """Mean change of the held-out PSNR, by drive, of the drives that both builds have; None if there are none."""
    changes = [new[drive_id] - old[drive_id] for drive_id in old.keys() & new]
    return sum(changes) / len(changes) if changes else None
