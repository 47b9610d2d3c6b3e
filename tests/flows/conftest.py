"""The `presight` command as a user starts it: a process of its own."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

Presight = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="session")
def presight(tmp_path_factory) -> Presight:
    """Runs the command in a workspace and gives its result; what Prefect keeps goes to a temporary folder."""
    environment = {**os.environ, "PREFECT_HOME": str(tmp_path_factory.mktemp("prefect"))}

    def run(workspace: Path, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "flows.cli", "--workspace", workspace, *arguments]
        text = [str(part) for part in command]
        return subprocess.run(text, capture_output=True, text=True, check=False, env=environment)

    return run
