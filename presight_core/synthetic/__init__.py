"""A procedural city, pictures of it with exact ground truth, and drives through it in the nuScenes format."""

from pathlib import Path

from presight_core.progress import Report, silent
from presight_core.synthetic.presets import PRESETS, SynthPreset, load_preset

__all__ = ["PRESETS", "SynthPreset", "load_preset", "write_dataset"]


def write_dataset(
    root: Path, preset: SynthPreset | str, seed: int, report: Report = silent, threads: int | None = None
) -> None:
    """Write a data set into a folder; see `presight_core.synthetic.dataset.write_dataset`."""
    from presight_core.synthetic import dataset  # brings the compiler along: only for those who render

    dataset.write_dataset(root, preset, seed, report, threads)
