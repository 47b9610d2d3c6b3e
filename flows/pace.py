"""How often a build tells the catalog where it is: as often as it likes, while that costs next to nothing."""

import time
from collections.abc import Callable

from presight_core.progress import Progress

COST_SHARE = 0.02  # of a build's time, at the most, goes into its reports


class Pace:
    """Sends reports on, but leaves some out where sending takes long.

    A catalog takes one writer at a time. Hundreds of tiles that report twice a second would keep it busy, and each
    other waiting; the longer each waits, the seldomer it reports. A new stage and the end of one are never left out.
    """

    def __init__(self, send: Callable[[Progress], None], clock: Callable[[], float] = time.monotonic) -> None:
        self._send = send
        self._clock = clock
        self._stage = ""
        self._next = 0.0

    def __call__(self, progress: Progress) -> None:
        """Send a report, if it is news or enough time has passed."""
        started = self._clock()
        is_news = progress.stage != self._stage or progress.done >= progress.total
        if not is_news and started < self._next:
            return
        self._send(progress)
        now = self._clock()
        self._stage, self._next = progress.stage, now + (now - started) / COST_SHARE
