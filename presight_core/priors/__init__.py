"""The prior's format: what is stored, and how a consumer reads it. Needs no Zarr library."""

from presight_core.priors.reader import CollectedError, PriorReader
from presight_core.priors.window import Window

__all__ = ["CollectedError", "PriorReader", "Window"]
