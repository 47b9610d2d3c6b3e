"""A Prefect server with a worker, as a team runs them: processes of their own, which a test may kill."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import httpx

from tests.servers import PrefectServer

REPOSITORY = Path(__file__).resolve().parents[2]
PATIENCE_S = 300  # for anything to happen, on however busy a machine
OVER = ("COMPLETED", "FAILED", "CRASHED", "CANCELLED")
Seen = TypeVar("Seen")


class Scheduler:
    """The server, the worker, and what the server says of runs."""

    def __init__(self, server: PrefectServer, folder: Path) -> None:
        self.server = server
        toy = f"{sys.executable} -m tests.flows.toy_worker"
        path = {"PYTHONPATH": str(REPOSITORY)}  # flow runs start in folders of their own
        self.environment = {**os.environ, **server.environment, **path, "PRESIGHT_WORKER": toy}
        self._log = folder / "worker.log"
        self._worker: subprocess.Popen | None = None

    def start_worker(self) -> None:
        """Start `presight serve-flows`, unless it runs."""
        if self._worker is None:
            command = [sys.executable, "-m", "flows.cli", "serve-flows"]
            with self._log.open("ab") as log:
                self._worker = subprocess.Popen(command, env=self.environment, stdout=log, stderr=log)

    def end_worker(self, number: int = signal.SIGTERM) -> None:
        """End the worker by a signal, if it runs; its flow runs are left alone."""
        if self._worker is not None:
            self._worker.send_signal(number)
            self._worker.wait(PATIENCE_S)
            self._worker = None

    def presight(self, workspace: Path, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
        """Run the command with this server named."""
        command = [sys.executable, "-m", "flows.cli", "--workspace", workspace, *arguments]
        text = [str(part) for part in command]
        return subprocess.run(text, capture_output=True, text=True, check=False, env=self.environment)

    def start(self, deployment: str, **parameters: Any) -> str:
        """Start a run by hand; its id."""
        deployment_id = self.call("GET", f"/deployments/name/{deployment}")["id"]
        asked = {"state": {"type": "SCHEDULED"}, "parameters": parameters}
        return self.call("POST", f"/deployments/{deployment_id}/create_flow_run", asked)["id"]

    def runs(self, deployment: str) -> list[dict[str, Any]]:
        """The deployment's runs, the earliest first."""
        deployment_id = self.call("GET", f"/deployments/name/{deployment}")["id"]
        chosen = {"flow_runs": {"deployment_id": {"any_": [deployment_id]}}, "sort": "EXPECTED_START_TIME_ASC"}
        return self.call("POST", "/flow_runs/filter", chosen)

    def state(self, run: str) -> dict[str, Any]:
        """The state of a run."""
        return self.call("GET", f"/flow_runs/{run}")["state"]

    def until(self, run: str, *types: str) -> dict[str, Any]:
        """Wait until a run is in a state of these types, or is over; the state."""

        def look() -> dict[str, Any] | None:
            state = self.state(run)
            return state if state["type"] in (*types, *OVER) else None

        return eventually(look)

    def call(self, method: str, path: str, value: Any = None) -> Any:
        """What the server answers."""
        answer = httpx.request(method, self.server.url + path, json=value, timeout=PATIENCE_S)
        answer.raise_for_status()
        return answer.json() if answer.content else None


def eventually(look: Callable[[], Seen | None]) -> Seen:
    """What `look` sees, as soon as it sees anything."""
    deadline = time.monotonic() + PATIENCE_S
    while not (seen := look()):
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.2)
    return seen
