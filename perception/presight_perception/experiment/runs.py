"""What is trained and how it is tried: plain values, so that equal ones share their work between experiments."""

import hashlib
import json
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from presight_perception.dataset import PositionNoise
from presight_perception.voxelise import VoxelDrop

ModelName = Literal["raster", "stream", "maptr", "bevdet-occ", "fb-occ"]
# geometry: ours without features; colours: ours with features that nothing was learned for, of a store of their own;
# nmp: Neural Map Prior, of the raster model alone
PriorKind = Literal["none", "presight", "geometry", "colours", "lidar", "nmp"]
MAP_MODELS: tuple[ModelName, ...] = ("raster", "stream", "maptr")
LINE_MODELS: tuple[ModelName, ...] = ("stream", "maptr")
OCCUPANCY_MODELS: tuple[ModelName, ...] = ("bevdet-occ", "fb-occ")


@dataclass(frozen=True)
class Schedule:
    """How long and how fast to learn."""

    steps: int = 600
    batch_size: int = 4
    learning_rate: float = 3e-3  # at its highest: one cycle
    weight_decay: float = 0.01


@dataclass(frozen=True)
class Run:
    """One training."""

    model: ModelName
    prior: PriorKind = "none"
    cameras: bool = True  # False: sees the prior alone (Table 7, setting b)
    seed: int = 0
    schedule: Schedule = field(default_factory=Schedule)
    # A prior that is hidden, whole or on one side, and never quite in place keeps the model looking at its cameras.
    drop: VoxelDrop = field(default_factory=lambda: VoxelDrop(whole_chance=0.4, side_chance=0.3))
    noise: PositionNoise = field(default_factory=lambda: PositionNoise(0.4))
    # Of a line model: how the raster mapper learned whose bird's-eye view it looks into. None: it learns its own.
    masks: Schedule | None = None

    @property
    def teacher(self) -> "Run | None":
        """The raster mapper with the same senses whose bird's-eye view this run takes over, if any."""
        return None if self.masks is None else replace(self, model="raster", schedule=self.masks, masks=None)

    @property
    def title(self) -> str:
        """For people."""
        senses = ([] if not self.cameras else ["cameras"]) + ([] if self.prior == "none" else [f"prior {self.prior}"])
        return f"{self.model}, {' and '.join(senses)}, seed {self.seed}"


@dataclass(frozen=True)
class Probe:
    """How a trained model is tried. By default it sees what it was trained with."""

    drives: Literal["all", "half", "none"] = "all"  # of the test city's prior
    cameras: bool = True  # False: its online features are zeros (Table 7, setting a)
    mirrored: bool = False  # the prior alone, left for right: a model that looks at its cameras notices
    noise: PositionNoise = field(default_factory=PositionNoise)


def digest(*values: Any) -> str:
    """A name for values that dataclasses and JSON can hold: the head of a SHA-256."""
    plain = [asdict(value) if hasattr(value, "__dataclass_fields__") else value for value in values]
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]
