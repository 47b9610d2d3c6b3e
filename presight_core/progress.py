"""How a long stage tells its caller where it is."""

from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Progress:
    """A moment of a stage: `done` of `total` units, with figures worth showing (loss, PSNR, rays/s)."""

    stage: str
    done: int
    total: int
    figures: dict[str, float] = field(default_factory=dict)


Report = Callable[[Progress], None]


def silent(progress: Progress) -> None:
    """A Report that shows nothing."""
