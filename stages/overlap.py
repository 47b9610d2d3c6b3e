"""How much ground two parts of a city's drives share: models tested where they were trained know the answers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from presight_core.errors import InputError

PLACE_M = 5.0  # positions in one cell of this size count once, so that a red light weighs nothing


@dataclass(frozen=True)
class Overlap:
    """Ground of the test drives that train drives passed, too."""

    test_places: int  # cells of 5 m that hold a camera of a test drive
    shared_places: int  # those within the distance of a train drive
    worst: tuple[tuple[str, float], ...]  # test drives and their shared share, the greatest first

    @property
    def share(self) -> float:
        """Shared part of the test ground, 0..1."""
        return self.shared_places / self.test_places if self.test_places else 0.0


def overlap(train_world: NDArray, test_world: dict[str, NDArray], within_m: float) -> Overlap:
    """What test drives, camera positions (N, 3) by name, share with those of all train drives (M, 3)."""
    if not len(train_world) or not test_world:
        return Overlap(0, 0, ())
    tree = KDTree(_places(train_world))
    places = {name: _places(positions) for name, positions in test_world.items()}
    shared = {name: _near(tree, cells, within_m) for name, cells in places.items()}
    worst = sorted(((name, float(near.mean())) for name, near in shared.items() if near.any()), key=lambda e: -e[1])
    every = np.unique(np.concatenate(list(places.values())), axis=0)
    return Overlap(len(every), int(_near(tree, every, within_m).sum()), tuple(worst))


def require_apart(city: str, found: Overlap, within_m: float) -> None:
    """Raise InputError, with the numbers, if train and test drives share ground."""
    if not found.shared_places:
        return
    drives = ", ".join(f"{name} {share:.0%}" for name, share in found.worst[:5])  # five show where to look
    raise InputError(
        f"{city}: train and test drives overlap: {found.share:.0%} of the test ground ({found.shared_places} of "
        f"{found.test_places} places of {PLACE_M:g} m) lies within {within_m:g} m of a train drive; most of it in "
        f"{drives}; move drives to another part of the split, or set split.allow_overlap = true"
    )


def _places(positions_world: NDArray) -> NDArray[np.float64]:
    """Centres (K, 2) of the cells that hold a camera."""
    cells = np.floor(np.asarray(positions_world, np.float64)[:, :2] / PLACE_M)
    return (np.unique(cells, axis=0) + 0.5) * PLACE_M


def _near(tree: KDTree, places: NDArray, within_m: float) -> NDArray[np.bool_]:
    return np.isfinite(tree.query(places, distance_upper_bound=within_m)[0])
