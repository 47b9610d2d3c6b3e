"""Leases: at most one run builds a city, and a run that was taken for dead can never speak again.

A lease is a row a city with a fencing number that only grows. Its holder renews it; where that stops, the lease
expires and the next run takes it with a greater number. The number goes into every generation: see
docs/decisions/009-leases-and-fencing.md.
"""

import os
import socket
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from presight_core.errors import ConflictError
from storage.database import Database, Query

LEASE_S = 60.0  # a run that is silent for so long is taken for dead

Clock = Callable[[], datetime]


class LeaseHeldError(ConflictError):
    """Somebody else builds the city now."""


class LeaseLostError(ConflictError):
    """The lease was given to somebody else, because its holder was silent for too long."""


@dataclass(frozen=True)
class Lease:
    """The right to build one city. Times are UTC, ISO 8601."""

    city: str
    token: int  # fencing number
    owner: str  # host, process and what tells it from a later one of the same number
    acquired_at: str
    heartbeat_at: str
    expires_at: str
    ended_at: str | None = None
    follows_lost: bool = False  # the lease before this one was not ended by its holder

    @property
    def holder(self) -> str:
        """The owner, for people."""
        host, process, *_ = (*self.owner.split(":"), "")
        return f"process {process} of {host}" if process else host

    def is_live(self, now: str) -> bool:
        """Whether its holder must be presumed at work."""
        return self.ended_at is None and now < self.expires_at and not is_gone(self.owner)


class Leases:
    """The leases of one catalog. Safe for many threads and processes at once."""

    def __init__(self, database: Database, clock: Clock) -> None:
        self._database = database
        self._clock = clock

    def take(self, city: str, owner: str, seconds: float = LEASE_S, above: int = 0) -> Lease:
        """The city's next lease, with a fencing number greater than every earlier one and than `above`.

        Raises LeaseHeldError while another one is live.
        """
        with self._database.writing() as query:
            now = self._now()
            before = _find(query, city)
            if before and before.is_live(text_of(now)):
                raise _held(before)
            token = max(before.token if before else 0, above) + 1
            values = {"city": city, "token": token, "owner": owner, "now": text_of(now)}
            query(TAKE, **values, expires_at=_after(now, seconds))
            lost = before is not None and before.ended_at is None
            return Lease(city, token, owner, text_of(now), text_of(now), _after(now, seconds), follows_lost=lost)

    def renew(self, lease: Lease, seconds: float = LEASE_S) -> None:
        """Say that the holder lives. Raises LeaseLostError if the lease is somebody else's by now."""
        with self._database.writing() as query:
            now = self._now()
            values = {"now": text_of(now), "expires_at": _after(now, seconds)}
            if not query(RENEW, city=lease.city, token=lease.token, **values):
                raise _lost(lease)

    def require(self, lease: Lease) -> None:
        """Raises LeaseLostError if the lease is no longer the holder's. Expired but not taken is still the holder's."""
        with self._database.reading() as query:
            require_current(query, lease)

    def end(self, lease: Lease) -> None:
        """Give the lease back; one that is lost already stays so."""
        with self._database.writing() as query:
            query(END, city=lease.city, token=lease.token, now=text_of(self._now()))

    def current(self, city: str) -> Lease | None:
        """The city's lease if its holder must be presumed at work."""
        with self._database.reading() as query:
            lease = _find(query, city)
        return lease if lease and lease.is_live(text_of(self._now())) else None

    def require_free(self, city: str) -> None:
        """Raise LeaseHeldError if somebody builds the city now."""
        lease = self.current(city)
        if lease:
            raise _held(lease)

    def lost(self) -> list[Lease]:
        """The leases whose holders fell silent and that nobody took since."""
        with self._database.reading() as query:
            leases = [Lease(**row) for row in query("SELECT * FROM leases WHERE ended_at IS NULL ORDER BY city")]
        now = text_of(self._now())
        return [lease for lease in leases if not lease.is_live(now)]

    def _now(self) -> datetime:
        return self._clock()


def require_current(query: Query, lease: Lease) -> None:
    """Raise LeaseLostError if the city has a newer lease, or this one was ended."""
    held = _find(query, lease.city)
    if held is None or held.token != lease.token or held.ended_at is not None:
        raise _lost(lease)


def text_of(time: datetime) -> str:
    """A time as the catalog keeps it: it sorts as text."""
    return time.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def this_process() -> str:
    """The name of this process as an owner: host, process number, when it started, and in which process space."""
    return f"{socket.gethostname()}:{os.getpid()}:{_started(os.getpid())}:{_space()}"


def is_gone(owner: str) -> bool:
    """Whether the owner was a process of this machine and container that certainly no longer runs."""
    parts = owner.rsplit(":", 3)
    if len(parts) != 4 or not parts[1].isdigit() or not _space() or parts[3] != _space():
        return False
    return _started(int(parts[1])) != parts[2]


def _started(process: int) -> str:
    """When a process started, in ticks since the machine did; empty where there is none or it is a corpse."""
    try:
        # The name, in brackets, may contain anything; after it come the state and 18 numbers before the start.
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return ""
    return "" if fields[0] in "ZX" else fields[19]


def _space() -> str:
    """What names this start of this machine and this container's process numbers; empty where nobody can tell."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot}/{Path('/proc/self/ns/pid').stat().st_ino}"
    except OSError:
        return ""


def _find(query: Query, city: str) -> Lease | None:
    rows: list[dict[str, Any]] = query("SELECT * FROM leases WHERE city = :city", city=city)
    return Lease(**rows[0]) if rows else None


def _after(now: datetime, seconds: float) -> str:
    return text_of(now + timedelta(seconds=seconds))


def _held(lease: Lease) -> LeaseHeldError:
    return LeaseHeldError(
        f"{lease.city}: {lease.holder} builds it since {lease.acquired_at}, last heard of at {lease.heartbeat_at}; "
        "wait for it with --wait, or try again later"
    )


def _lost(lease: Lease) -> LeaseLostError:
    return LeaseLostError(
        f"{lease.city}: lease {lease.token} of {lease.holder} is no longer its own, because it was silent for too "
        "long; nothing of it is published: run `presight build` again"
    )


TAKE = """
    INSERT INTO leases (city, token, owner, acquired_at, heartbeat_at, expires_at)
    VALUES (:city, :token, :owner, :now, :now, :expires_at)
    ON CONFLICT (city) DO UPDATE SET token = excluded.token, owner = excluded.owner,
        acquired_at = excluded.acquired_at, heartbeat_at = excluded.heartbeat_at,
        expires_at = excluded.expires_at, ended_at = NULL"""
RENEW = """
    UPDATE leases SET heartbeat_at = :now, expires_at = :expires_at
    WHERE city = :city AND token = :token AND ended_at IS NULL RETURNING city"""
END = "UPDATE leases SET ended_at = :now WHERE city = :city AND token = :token AND ended_at IS NULL"
