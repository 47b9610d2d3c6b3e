"""Pipelines: order, overlap, errors and the share of time that each step works."""

import threading

import pytest

from stages.pipeline import Pipeline, Step


def test_results_come_in_the_order_of_the_items():
    gate = threading.Event()

    def slow_first(item: int) -> int:
        if item == 0:
            assert gate.wait(10)
        elif item == 3:
            gate.set()
        return item

    pipeline = Pipeline([Step("slow first", slow_first, threads=4), Step("double", lambda item: 2 * item)])
    assert list(pipeline.run(range(8))) == [0, 2, 4, 6, 8, 10, 12, 14]


def test_steps_work_at_the_same_time():
    barrier = threading.Barrier(2, timeout=10)  # breaks unless both steps are in it at once
    first = Step("first", lambda item: barrier.wait() * 0 + item if item > 0 else item)
    second = Step("second", lambda item: barrier.wait() * 0 + item if item < 4 else item)
    assert list(Pipeline([first, second]).run(range(5))) == [0, 1, 2, 3, 4]


def test_items_are_taken_only_as_fast_as_they_are_used():
    taken = []
    results = Pipeline([Step("same", lambda item: item)]).run(taken.append(i) or i for i in range(1000))
    assert next(results) == 0
    assert len(taken) < 20


def test_what_a_step_raises_reaches_the_caller():
    def failing(item: int) -> int:
        if item == 5:
            raise ValueError("five")
        return item

    results = Pipeline([Step("failing", failing), Step("same", lambda item: item)]).run(range(100))
    assert [next(results) for _ in range(5)] == [0, 1, 2, 3, 4]
    with pytest.raises(ValueError, match="five"):
        next(results)


def test_the_share_of_a_step_is_its_time_at_work():
    pipeline = Pipeline([Step("noted", lambda item: item), Step("idle", lambda item: item)])
    list(pipeline.run(range(3)))
    pipeline.note("noted", 1e6)
    shares = pipeline.shares()
    assert shares["noted"] > 1
    assert shares["idle"] < 1
