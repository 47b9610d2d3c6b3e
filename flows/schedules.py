"""Which flows of a city a Prefect server may start, and when."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from flows.machines import HERE, Machines
from presight_core.errors import SettingsError

FLOWS = {  # and where a worker finds them
    "rebuild": "flows.scheduled.rebuild",
    "update": "flows.scheduled.update",
    "reconcile": "flows.scheduled.reconcile_city",
    "gc": "flows.scheduled.collect_garbage",
}
BUILDING = ("rebuild", "update")  # the others may run beside them
UNNAMED = "rebuild"  # the flow of a cron without a name
AFTER_INGEST = "update"


@dataclass(frozen=True)
class Schedules:
    """When which flows of a city start, and on what they build. Raises SettingsError for what cannot be meant."""

    crons: dict[str, str] = field(default_factory=dict)  # by flow; one without starts by hand or by an event only
    timezone: str = "UTC"
    on_ingest: bool = False
    pool: str = "presight"
    machines: Machines = HERE

    def __post_init__(self) -> None:
        for flow in self.crons.keys() - FLOWS.keys():
            raise SettingsError(f"--cron {flow}=...: no such flow; there are {', '.join(FLOWS)}")
        try:
            ZoneInfo(self.timezone)
        except (ZoneInfoNotFoundError, ValueError):
            raise SettingsError(f"--timezone {self.timezone}: no such zone; write one as Asia/Singapore") from None
        for cron in self.crons.values():
            _check(cron)


def crons_from(texts: Iterable[str]) -> dict[str, str]:
    """Schedules by flow, of texts `CRON` or `FLOW=CRON`."""
    named = [text.partition("=") if "=" in text else (UNNAMED, "=", text) for text in texts]
    return {flow.strip(): cron.strip() for flow, _, cron in named}


def _check(cron: str) -> None:
    from prefect.client.schemas.schedules import CronSchedule

    try:
        CronSchedule(cron=cron)
    except ValueError:
        raise SettingsError(
            f"--cron {cron!r} is no schedule; write minute, hour, day, month and weekday: '0 2 * * 6' is Saturdays at 2"
        ) from None
