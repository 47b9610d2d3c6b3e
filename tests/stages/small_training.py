"""Settings under which a tile trains in a moment."""

from presight_core.config import CitySettings, load_city_settings

TINY = (
    "training.steps=12", "training.batch_rays=64", "training.checkpoint_every=6", "training.holdout_every=4",
    "field.hidden_width=8", "field.proposal_width=8", "field.grid.log2_rows=8", "field.grid.max_resolution=64",
    "field.grid.levels=3", "sampling.proposal_samples=[12, 8]", "sampling.field_samples=8",
)  # fmt: skip


def tiny_settings(*overrides: str) -> CitySettings:
    return load_city_settings(None, ["preset=demo", *TINY, *overrides])
