"""Steps that work at the same time, each on its own threads, with results in order and every step's busy share."""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from time import perf_counter
from typing import Any

AHEAD = 2  # items between two steps: a hiccup of one does not stop the next


@dataclass(frozen=True)
class Step:
    """One thing done to every item; `threads` of it at once."""

    name: str
    work: Callable[[Any], Any]
    threads: int = 1


class Pipeline:
    """Sends items through steps; the slowest step alone sets the pace."""

    def __init__(self, steps: Sequence[Step]):
        self._steps = steps
        self._busy = dict.fromkeys((step.name for step in steps), 0.0)
        self._lock = threading.Lock()
        self._started = perf_counter()

    def run(self, items: Iterable[Any]) -> Iterator[Any]:
        """The results, in the order of the items. What a step raises is raised here."""
        self._started = perf_counter()
        room = sum(step.threads + AHEAD for step in self._steps)
        with ExitStack() as stack:
            pools = [ThreadPoolExecutor(step.threads) for step in self._steps]
            for pool in pools:
                stack.callback(pool.shutdown, cancel_futures=True)
            waiting: deque[Future[Any]] = deque()
            for item in items:
                waiting.append(self._submit(pools, item))
                if len(waiting) > room:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()

    def shares(self) -> dict[str, float]:
        """How much of its threads' time each step has worked since `run` began, 0..1; the slowest is next to 1."""
        seconds = max(perf_counter() - self._started, 1e-9)
        with self._lock:
            return {step.name: self._busy[step.name] / (seconds * step.threads) for step in self._steps}

    def note(self, name: str, seconds: float) -> None:
        """Add working time to a step."""
        with self._lock:
            self._busy[name] += seconds

    def _submit(self, pools: Sequence[ThreadPoolExecutor], item: Any) -> Future[Any]:
        """Queue an item at every step. Each queue has the items' order, so that no step waits for a later item."""
        future: Future[Any] = Future()
        future.set_result(item)
        for step, pool in zip(self._steps, pools, strict=True):
            future = pool.submit(self._work, step, future)
        return future

    def _work(self, step: Step, before: Future[Any]) -> Any:
        value = before.result()
        started = perf_counter()
        try:
            return step.work(value)
        finally:
            self.note(step.name, perf_counter() - started)
