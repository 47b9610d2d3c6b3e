"""What Prefect's environment must be, in one place. It is set before Prefect is imported, which nothing here does."""

import os

from presight_core.errors import SettingsError

API_URL = "PREFECT_API_URL"
ENVIRONMENT = {
    # The embedded Prefect server needs 14-29 s on a cold start, more on a busy machine.
    "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": "120",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",  # it reports to nobody
    "DO_NOT_TRACK": "1",
    "PREFECT_RESULTS_DEFAULT_SERIALIZER": "json",  # Prefect's own default is pickle, which nobody here may read
}


def prepare(log_level: str) -> None:
    """Tell Prefect how to behave, where the user did not."""
    for name, value in {**ENVIRONMENT, "PREFECT_LOGGING_LEVEL": log_level}.items():
        os.environ.setdefault(name, value)


def server_url() -> str | None:
    """The API of the Prefect server that the user named, if they named one."""
    return os.environ.get(API_URL) or None


def require_server() -> str:
    """The API of the Prefect server. Raises SettingsError if none is named."""
    url = server_url()
    if url is None:
        raise SettingsError(
            f"no Prefect server is named: start one with `prefect server start --host 127.0.0.1`, then "
            f"export {API_URL}=http://127.0.0.1:4200/api (docs/schedules.md)"
        )
    return url
