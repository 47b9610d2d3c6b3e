"""Rows R4 and R5 of docs/reliability.md: system calls that fail, by strace, and disks that are full, by tmpfs."""

import os
import shutil
import signal
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.torture import children
from tests.torture.conftest import copy_of, whole_run
from tests.torture.test_crashes import everything
from tests.torture.toy_city import ToyCity

pytestmark = pytest.mark.slow

OURS = {2, 4, 5, 6}  # exit codes of typed errors: of input, of the store, of conflicts, of a build
CALLS = ("openat", "write", "pwrite64", "fsync", "rename,renameat,renameat2,link,linkat", "mkdir,mkdirat")
ERRORS = ("ENOSPC", "EIO", "EDQUOT", "EACCES")


def strace_works() -> bool:
    """Whether this machine lets us trace our own children."""
    if shutil.which("strace") is None:
        return False
    return subprocess.run(["strace", "-o", "/dev/null", "true"], capture_output=True, check=False).returncode == 0


@contextmanager
def injected(process: int, calls: str, error: str, when: int):
    """Let the n-th of these system calls of every thread of a process fail, from now on."""
    rule = f"inject={calls}:error={error}:when={when}"
    command = ["strace", "-f", "-q", "-o", "/dev/null", "-e", f"trace={calls}", "-e", rule, "-p", str(process)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as tracer:
        try:
            until_traced(process)
            yield
        finally:
            tracer.send_signal(signal.SIGTERM)  # it lets go of the process


def until_traced(process: int) -> None:
    """Wait until strace has attached."""
    for _ in range(2000):
        status = Path(f"/proc/{process}/status").read_text()
        if "TracerPid:\t0\n" not in status:
            return
        time.sleep(0.005)
    raise AssertionError("strace did not attach")


def stands(city: ToyCity, code: int, said: list, truth: dict[str, str], log: Path) -> None:
    """A typed error or success; what is shown is old or new, whole; with the fault gone the next run completes."""
    assert code == 0 or code in OURS, f"exit code {code}: {log.read_text()[-3000:]}"
    shown = children.result(city.check, log)
    assert shown in ({}, truth)
    if code == 0 or any("generation" in each for each in said):
        assert shown == truth
    assert children.result(whole_run(city), log) == truth


def held(work, pipe: int):
    """`work` that starts when a byte comes through the pipe."""

    def waiting(acknowledge) -> None:
        os.read(pipe, 1)
        work(acknowledge)

    return waiting


@pytest.mark.parametrize("calls", CALLS)
def test_a_failing_system_call_is_a_typed_error_and_what_is_shown_stays(calls, city, prepared, truth, is_long):
    if not strace_works():
        pytest.skip("strace cannot trace here: install it, or allow ptrace")
    meetings = range(1, 200) if is_long else (1, 2, 3, 5, 8, 13, 21, 34, 55, 89)
    for number, when in enumerate(meetings):
        city = copy_of(prepared, city.root.parent)
        log = city.root.parent / "log"
        log.unlink(missing_ok=True)
        waits, go = os.pipe()
        child = children.start(held(everything(city), waits), log)
        with injected(child.process, calls, ERRORS[number % len(ERRORS)], when):
            os.write(go, b".")
            code, said = child.wait()
        os.close(waits)
        os.close(go)
        stands(city, code, said, truth, log)


@pytest.fixture
def disk(tmp_path):
    """Mounts a small disk; skips where that is not allowed."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", str(folder)]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("a tmpfs cannot be mounted here: be root")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_full_disk_is_a_typed_error_and_what_is_shown_stays(disk, prepared, truth, is_long):
    whole = copy_of(prepared, disk / "whole")
    children.result(whole_run(whole), disk / "log")
    need = sum(file.stat().st_size for file in whole.root.rglob("*") if file.is_file())
    shutil.rmtree(whole.root.parent)
    shares = [number / 60 for number in range(60)] if is_long else [0.02, 0.2, 0.4, 0.6, 0.9]
    failed = 0
    for share in shares:
        city, log = copy_of(prepared, disk), disk.parent / "log"
        ballast = disk / "ballast"
        status = os.statvfs(disk)
        ballast.write_bytes(bytes(int(status.f_bavail * status.f_frsize - share * need)))
        code, said = children.run(everything(city), log)
        failed += code != 0
        assert code == 0 or code in OURS, f"{share:.0%} free: exit code {code}: {log.read_text()[-3000:]}"
        assert children.result(city.check, log) in ({}, truth)
        ballast.unlink()
        stands(city, code, said, truth, log)
    assert failed >= len(shares) // 2, "the disk was never full"
