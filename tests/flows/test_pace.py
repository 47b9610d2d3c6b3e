"""Reports go to the catalog as often as it can take them."""

from flows.pace import Pace
from presight_core.progress import Progress


class SlowCatalog:
    """Takes a fixed time for each report; the same object is the clock."""

    def __init__(self, seconds: float) -> None:
        self.now, self.seconds, self.heard = 100.0, seconds, []

    def send(self, progress: Progress) -> None:
        self.now += self.seconds
        self.heard.append(progress)

    def clock(self) -> float:
        return self.now


def build(catalog: SlowCatalog, steps: int = 1000, stage: str = "training") -> None:
    """A report every half second."""
    pace = Pace(catalog.send, catalog.clock)
    for step in range(1, steps + 1):
        pace(Progress(stage, step, steps))
        catalog.now += 0.5


def test_a_quick_catalog_hears_every_report():
    catalog = SlowCatalog(0.005)
    build(catalog)
    assert len(catalog.heard) == 1000


def test_a_slow_catalog_takes_a_fiftieth_of_the_time_at_the_most():
    catalog = SlowCatalog(0.2)
    build(catalog)
    assert 0.01 < len(catalog.heard) * 0.2 / (catalog.now - 100) <= 0.02


def test_news_is_never_left_out():
    catalog = SlowCatalog(10.0)
    pace = Pace(catalog.send, catalog.clock)
    told = [Progress("training", 1, 9), Progress("training", 9, 9), Progress("evaluation", 1, 3)]
    for progress in [told[0], Progress("training", 2, 9), *told[1:]]:
        pace(progress)
    assert catalog.heard == told
