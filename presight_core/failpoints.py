"""Named places at which a test lets the program die, fail or wait. They cost one comparison when off.

PRESIGHT_FAILPOINT=name[:action][@n] arms them; several are separated by commas. The action is kill (the default:
the process is gone at once, as by kill -9), raise, stop (until SIGCONT) or sleep=SECONDS; n is which meeting
counts (1: the first).
"""

import os
import signal
import time
from collections import Counter
from dataclasses import dataclass

VARIABLE = "PRESIGHT_FAILPOINT"
NAMES = (
    "drive-before-rename",  # a drive's frames are written, not yet in place
    "drive-after-rename",  # a drive is in the index, not yet in the catalog
    "catalog-before-commit",  # a transaction of the catalog is complete, not yet committed
    "catalog-after-commit",
    "folder-before-rename",  # an artifact or a checkpoint is written, not yet in place
    "folder-after-rename",
    "slab-before-write",  # in the middle of a tile's group
    "store-before-put",  # any document of the store: a city, a finished group, a generation
    "store-after-put",
    "file-before-link",  # a document of a store in a folder, or a pin, is on the disk, not yet named
    "store-before-delete",  # a generation, a tag, or the document of a build that nobody needs
    "store-after-delete",
    "group-half-deleted",  # a useless build has lost its document, not yet its chunks
    "lease-taken",  # the city is ours, nothing else was done
    "lease-ended",  # the city is free, the builds are not yet ended
    "publish-before",  # everything is validated, nothing is shown
    "publish-after",  # the generation is shown, the catalog does not know
)


class FailpointError(OSError):
    """What the action `raise` raises."""


@dataclass(frozen=True)
class _Armed:
    action: str
    meeting: int


_met: Counter[str] = Counter()
_armed: dict[str, _Armed] = {}


def failpoint(name: str) -> None:
    """Do here what a test asked for, if it did."""
    if _armed:
        _meet(name)


def arm(setting: str) -> None:
    """Arm the failpoints of a setting and forget what was met; the empty setting disarms all."""
    _met.clear()
    _armed.clear()
    for part in filter(None, setting.split(",")):
        rest, _, meeting = part.partition("@")
        name, _, action = rest.partition(":")
        if name not in NAMES:
            raise ValueError(f"{VARIABLE}: no failpoint {name!r}; there are {', '.join(NAMES)}")
        _armed[name] = _Armed(action or "kill", int(meeting or 1))


def _meet(name: str) -> None:
    _met[name] += 1
    armed = _armed.get(name)
    if armed is None or armed.meeting != _met[name]:
        return
    match armed.action.partition("="):
        case "kill", _, _:
            os.kill(os.getpid(), signal.SIGKILL)
        case "stop", _, _:
            os.kill(os.getpid(), signal.SIGSTOP)
        case "sleep", _, seconds:
            time.sleep(float(seconds))
        case _:
            raise FailpointError(f"failpoint {name}")


arm(os.environ.get(VARIABLE, ""))
