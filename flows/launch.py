"""Run one job in a process of its own: its memory is freed, it can be killed, and numba's threads are its own."""

import json
import os
import shlex
import subprocess
import sys
from collections import deque
from contextlib import suppress
from typing import Any

from flows.jobs import Job
from presight_core import errors
from presight_core.errors import BuildError, PresightError
from presight_core.progress import Progress, Report, silent

# PRESIGHT_WORKER: another command that does a job, for example `srun --gpus=1 python -m flows.worker`.
WORKER = shlex.split(os.environ.get("PRESIGHT_WORKER", "")) or [sys.executable, "-m", "flows.worker"]
KEPT_LINES = 12  # of a crashed worker's output: a traceback's end


class WorkerLostError(BuildError):
    """A worker process ended without a result: killed, out of memory, or crashed."""


def run_job(command: str, job: Job, report: Report = silent) -> dict[str, Any]:
    """The result of a worker command. Raises the PresightError it raised, or WorkerLostError if it died."""
    last_lines: deque[str] = deque(maxlen=KEPT_LINES)
    outcome: dict[str, Any] = {}
    with subprocess.Popen(
        [*WORKER, command],
        stdin=subprocess.PIPE,  # brings the job; then stays open while we live: the worker ends when it closes
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=worker_environment(job.threads),
    ) as process:
        assert process.stdout is not None
        try:
            _hand_over(job, process)
            for line in process.stdout:
                message = _message(line)
                if message is None:
                    last_lines.append(line.rstrip())
                elif "progress" in message:
                    report(Progress(**message["progress"]))
                else:
                    outcome = message
        except BaseException:
            process.terminate()
            raise
    if "error" in outcome:
        raise _error(**outcome["error"])
    if "result" not in outcome:
        end = "\n".join(last_lines)
        raise WorkerLostError(f"{command}: the worker ended with status {process.returncode} and no result\n{end}")
    return outcome["result"]


def worker_environment(threads: int) -> dict[str, str]:
    """The environment of a worker: thread counts that agree, and threads that sleep rather than spin."""
    counts = {name: str(threads) for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    return {**os.environ, **counts, "OMP_WAIT_POLICY": "passive", "PYTHONUNBUFFERED": "1"}


def _hand_over(job: Job, process: subprocess.Popen[str]) -> None:
    """Write the job to the worker: as an argument, it could not exceed 128 KiB, some 2,000 drives."""
    assert process.stdin is not None
    try:
        process.stdin.write(job.to_json() + "\n")
        process.stdin.flush()
    except BrokenPipeError:  # it is dead already: its status and last words tell why
        with suppress(BrokenPipeError):
            process.stdin.close()


def _message(line: str) -> dict[str, Any] | None:
    """A worker's message, or None for a line of ordinary output."""
    if not line.startswith("{"):
        return None
    try:
        message = json.loads(line)
    except json.JSONDecodeError:
        return None
    return message if message.keys() & {"progress", "result", "error"} else None


def _error(name: str, message: str) -> PresightError:
    """The error that the worker raised, as far as it is one of ours."""
    known = vars(errors).get(name)
    if isinstance(known, type) and issubclass(known, PresightError):
        return known(message)
    return BuildError(f"{name}: {message}")
