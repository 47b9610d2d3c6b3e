"""The prior's format: what is stored, and how a consumer reads it. Needs numpy, zarr and obstore only."""

from presight_core.priors.reader import PriorReader
from presight_core.priors.window import Window

__all__ = ["PriorReader", "Window"]
