"""The part of a city's split that a drive belongs to: train, prior or test."""

from collections.abc import Iterable
from fnmatch import fnmatchcase

from presight_core.config import SplitSettings
from presight_core.errors import SettingsError
from presight_core.nuscenes_split import Role, role_of


def part_of(name: str, settings: SplitSettings) -> Role:
    """What the drive of a scene is for.

    Raises SettingsError for a drive on two lists, or on none where there are lists and no `rest`; InputError for a
    name that the paper's split cannot know.
    """
    if settings.named == "paper":
        _require_no_lists(settings)
        return role_of(name)
    lists: dict[Role, tuple[str, ...]] = {"train": settings.train, "prior": settings.prior, "test": settings.test}
    parts: list[Role] = [part for part, patterns in lists.items() if _is_on(name, patterns)]
    if len(parts) > 1:
        raise SettingsError(f"split: {name} is on the lists {' and '.join(parts)}; keep it on one")
    if parts:
        return parts[0]
    if settings.rest is None and any(lists.values()):
        raise SettingsError(
            f'split: {name} is on no list; put it on one, or say what other drives are for: rest = "prior"'
        )
    return settings.rest or "prior"


def _is_on(name: str, patterns: Iterable[str]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def _require_no_lists(settings: SplitSettings) -> None:
    if settings.train or settings.prior or settings.test or settings.rest:
        raise SettingsError('split: named = "paper" says it of every drive; take the lists and `rest` away')
