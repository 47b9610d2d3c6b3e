"""Forks of a warm parent: each does one thing to a toy city, and may be killed at it.

The parent itself never touches a store: the threads of the object store's library do not survive a fork.
"""

import io
import json
import os
import select
import signal
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from presight_core import failpoints
from presight_core.errors import PresightError, StoreError

KILLED = -signal.SIGKILL
PATIENCE_S = 120  # a child that takes longer hangs, on however busy a machine


_running: set[int] = set()


@dataclass
class Child:
    """A forked process and what it says."""

    process: int
    output: int  # the pipe's end that we read
    log: Path

    def wait(self) -> tuple[int, list[Any]]:
        """Its exit code (negative: the signal that killed it) and all that it acknowledged."""
        deadline = time.monotonic() + PATIENCE_S
        while not (ended := os.waitpid(self.process, os.WNOHANG))[0]:
            if time.monotonic() > deadline:
                os.kill(self.process, signal.SIGKILL)
                os.waitpid(self.process, 0)
                _running.discard(self.process)
                raise AssertionError(f"a child hangs; {self.log.read_text()}")
            time.sleep(0.002)
        _running.discard(self.process)
        with os.fdopen(self.output, "rb") as pipe:
            lines = pipe.read().decode().splitlines()
        return os.waitstatus_to_exitcode(ended[1]), [json.loads(line) for line in lines]

    def until_said(self) -> None:
        """Wait until it has acknowledged something, or ended."""
        select.select([self.output], [], [], PATIENCE_S)

    def signal(self, number: int) -> None:
        """Send it a signal."""
        os.kill(self.process, number)

    def until_stopped(self) -> None:
        """Wait until it has stopped itself at a failpoint."""
        _, status = os.waitpid(self.process, os.WUNTRACED)
        assert os.WIFSTOPPED(status), f"it ended before it stopped; {self.log.read_text()}"


Acknowledge = Callable[[Any], None]


def start(work: Callable[[Acknowledge], Any], log: Path, setting: str = "") -> Child:
    """Fork a child that does `work` with these failpoints armed.

    It ends with 0, with the exit code of an error of ours, or with 99 for any other error.
    """
    reading, writing = os.pipe()
    errors = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)  # here, where no fault is injected
    sys.stdout.flush()
    sys.stderr.flush()
    process = os.fork()
    if process:
        os.close(writing)
        os.close(errors)
        _running.add(process)
        return Child(process, reading, log)
    try:
        os.close(reading)
        os.dup2(errors, 2)
        sys.stdout = sys.stderr = io.StringIO()  # a terminal's faults are not what is tested
        failpoints.arm(setting)
        os._exit(_exit_code(lambda: work(lambda value: _say(writing, value))))
    finally:
        os._exit(98)  # whatever happens, the child never becomes a second test run


def _exit_code(work: Callable[[], Any]) -> int:
    """What the command would end with."""
    try:
        work()
    except PresightError as error:
        _log(f"{type(error).__name__}: {error}\n")
        return error.exit_code
    except OSError as error:  # as the command does
        _log(traceback.format_exc())
        return StoreError.exit_code if error.errno else 99
    except BaseException:
        _log(traceback.format_exc())
        return 99
    return 0


def _log(text: str) -> None:
    os.writev(2, [text.encode()])  # not `write`, which a test may let fail


def run(work: Callable[[Acknowledge], Any], log: Path, setting: str = "") -> tuple[int, list[Any]]:
    """Start a child and wait for its end."""
    return start(work, log, setting).wait()


def result(work: Callable[[], Any], log: Path) -> Any:
    """What `work` returns in a child of its own (a JSON value). AssertionError if it fails."""
    code, said = run(lambda acknowledge: acknowledge(work()), log)
    assert code == 0, log.read_text()
    return said[-1]


def end_all() -> None:
    """Kill the children that a failed test left behind, the stopped ones too."""
    while _running:
        process = _running.pop()
        with suppress(ProcessLookupError, ChildProcessError):  # its end was seen already
            os.kill(process, signal.SIGKILL)
            os.waitpid(process, 0)


def _say(pipe: int, value: Any) -> None:
    os.writev(pipe, [(json.dumps(value) + "\n").encode()])
