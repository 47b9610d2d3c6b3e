"""What can go wrong, as a small tree by what the caller can do about it.

Every message states the fact, the values, then the cure. The command line prints it as one line
and ends with the class's `exit_code`.
"""


class PresightError(Exception):
    """Anything PreSight reports on purpose."""

    exit_code = 1


class InputError(PresightError, ValueError):
    """Data handed to a stage breaks that stage's contract; fix the data."""

    exit_code = 2


class SettingsError(PresightError, ValueError):
    """A setting is unknown, misspelt or out of range; fix the setting."""

    exit_code = 2


class NotFoundError(PresightError, LookupError):
    """A city, drive, tile, generation or artifact does not exist (yet)."""

    exit_code = 2


class MissingDependencyError(PresightError, ImportError):
    """An optional package or system library is needed and absent; install it."""

    exit_code = 3


class StoreError(PresightError):
    """The store or the catalog is damaged, newer than this program, or cannot be reached."""

    exit_code = 4


class ConflictError(PresightError):
    """Somebody else changed or holds what this call wanted to change; run it again."""

    exit_code = 5


class BuildError(PresightError):
    """A tile could not be built or did not pass validation; nothing was published for it."""

    exit_code = 6
