"""Row R1 of docs/reliability.md: any sequence of publishing, fencing, rolling back and opening equals a dict."""

import os
import shutil
import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from presight_core.errors import ConflictError
from presight_core.priors.documents import GenerationTile
from presight_core.priors.example import ExampleTile
from presight_core.priors.reader import PriorReader
from storage.priors import PriorStore
from storage.tile_groups import TileName
from tests.torture.conftest import LONG

CITY = "town"
TILES = ("t000", "t001", "t002")
TILING = {
    "tiling_id": "tiling-1",
    "city": CITY,
    "tiles": [{"tile_id": tile, "centroid_m": [100.0 * place, 0.0]} for place, tile in enumerate(TILES)],
}
EXAMPLE = ExampleTile(side_blocks=1)
EXAMPLES, STEPS = (1000, 500) if os.environ.get(LONG) else (200, 50)


class StoreEqualsModel(RuleBasedStateMachine):
    """The model: for every generation a dict from tile to build, and the fence."""

    @initialize()
    def make(self) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="presight-model-"))
        self.store = PriorStore.open(self.folder)
        self.store.create_city(CITY, EXAMPLE.lattice, "space-1", EXAMPLE.channel_count)
        drives = ["a", "b", "c"]
        self.entries = {
            tile: self.store.write_tile(CITY, TileName(tile, "b1"), EXAMPLE.batches(), drives, {}) for tile in TILES
        }
        self.store.publish(CITY, {}, None, TILING)
        self.model: list[dict[str, int]] = [{}]
        self.fence, self.built = 0, 0

    def teardown(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)

    @rule(tile=st.sampled_from(TILES), behind=st.integers(0, 3), lag=st.integers(-1, 2), fenced=st.booleans())
    def publish(self, tile: str, behind: int, lag: int, fenced: bool) -> None:
        """Publish a build that was planned some generations ago, with or without a fencing number."""
        parent = max(1, len(self.model) - behind)
        fence = max(0, self.fence - lag) if fenced else None
        self.built += 1
        new = {tile: GenerationTile(self.entries[tile], {"build": self.built})}
        changed = self.model[-1].get(tile) != self.model[parent - 1].get(tile)
        if changed or (fence is not None and fence < self.fence):
            with pytest.raises(ConflictError):
                self.store.publish(CITY, new, parent, fence=fence)
            return
        assert self.store.publish(CITY, new, parent, fence=fence) == len(self.model) + 1
        self.model.append({**self.model[-1], tile: self.built})
        self.fence = max(self.fence, fence or 0)

    @rule(step=st.integers(-1, 2))
    def raise_fence(self, step: int) -> None:
        fence = max(0, self.fence + step)
        if fence < self.fence:
            with pytest.raises(ConflictError):
                self.store.raise_fence(CITY, fence)
            return
        self.store.raise_fence(CITY, fence)
        if fence > self.fence:
            self.model.append(self.model[-1])
            self.fence = fence

    @rule(back=st.integers(0, 5))
    def roll_back(self, back: int) -> None:
        number = max(1, len(self.model) - back)
        if self.store.rollback(CITY, number) > len(self.model):
            self.model.append(self.model[number - 1])

    @rule()
    def open_again(self) -> None:
        self.store = PriorStore.open(self.folder)

    @rule(back=st.integers(0, 5))
    def read(self, back: int) -> None:
        """A reader sees exactly the generation that it opened."""
        number = max(1, len(self.model) - back)
        reader = PriorReader.open(self.folder, CITY, number)
        assert self.seen(reader.generation) == self.model[number - 1]

    @invariant()
    def the_newest_is_the_model(self) -> None:
        if hasattr(self, "model"):
            head = self.store.generation(CITY)
            assert head is not None
            assert (head.number, self.seen(head), head.fence) == (len(self.model), self.model[-1], self.fence)

    @staticmethod
    def seen(generation) -> dict[str, int]:
        return {tile: shown.recipe["build"] for tile, shown in generation.tiles.items()}


StoreEqualsModel.TestCase.settings = settings(
    max_examples=EXAMPLES, stateful_step_count=STEPS, deadline=None, suppress_health_check=list(HealthCheck)
)
TestStore = pytest.mark.slow(StoreEqualsModel.TestCase)
