"""Where priors are read from: a folder or an object-store URL.

Folders are read without obstore. Its threads do not survive a fork, and data loaders fork.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from urllib.parse import unquote, urlsplit

import obstore
from obstore.exceptions import BaseError
from obstore.store import ObjectStore as RemoteStore
from obstore.store import from_url

from presight_core.errors import StoreError

MOST_REQUESTS = 32  # at once: hides the latency of an object store, and stays below its limits for one client

_remote_pid: list[int] = []  # the process that first reached an object store; a fork of it cannot


def local_folder(location: str | Path) -> Path | None:
    """The folder that a path or a file:// URL names; None for another URL."""
    if isinstance(location, Path) or "://" not in location:
        return Path(location)
    parts = urlsplit(location)
    return Path(unquote(parts.path)) if parts.scheme == "file" else None


class ReadLocation:
    """Read access to a folder or URL. Raises StoreError where it cannot be reached."""

    def __init__(self, location: str | Path) -> None:
        self._name = str(location)
        self._place = local_folder(location) or _remote_store(self._name)

    def __str__(self) -> str:
        return self._name

    def read(self, path: str) -> bytes | None:
        """The content of one object; None if there is none."""
        try:
            if isinstance(self._place, Path):
                with open(f"{self._place}/{path}", "rb", buffering=0) as file:  # noqa: PTH123 - Path joins cost as much as the read
                    return file.readall()
            return bytes(obstore.get(self._place, path).bytes())
        except FileNotFoundError:
            return None
        except (OSError, BaseError) as error:
            raise StoreError(f"{self._name}/{path}: {error}; check the location and your access to it") from error

    @property
    def is_remote(self) -> bool:
        """Whether every read costs a request."""
        return not isinstance(self._place, Path)

    def names(self, folder: str) -> list[str]:
        """Names of the objects directly in a folder; empty if there is none."""
        try:
            if isinstance(self._place, Path):
                entries = (self._place / folder).iterdir()
                # With a # in its name a file is an unfinished write.
                return sorted(entry.name for entry in entries if entry.is_file() and "#" not in entry.name)
            objects = obstore.list_with_delimiter(self._place, folder)["objects"]
            # Some servers list a folder that was emptied as an object of the folder's own name.
            paths = [entry["path"] for entry in objects if entry["path"].startswith(f"{folder}/")]
            return sorted(path.rpartition("/")[2] for path in paths)
        except FileNotFoundError:
            return []
        except (OSError, BaseError) as error:
            raise StoreError(f"{self._name}/{folder}: {error}; check the location and your access to it") from error

    def read_all(self, paths: Sequence[str]) -> list[bytes | None]:
        """The contents of many objects; those at a URL are fetched side by side."""
        if isinstance(self._place, Path) or len(paths) < 2:
            return [self.read(path) for path in paths]
        with ThreadPoolExecutor(min(len(paths), MOST_REQUESTS)) as pool:
            return list(pool.map(self.read, paths))


def _remote_store(url: str) -> RemoteStore:
    if _remote_pid and _remote_pid[0] != os.getpid():
        raise StoreError(f"{url}: cannot be read in a forked process; start workers with 'spawn' or 'forkserver'")
    _remote_pid[:] = [os.getpid()]
    try:
        return from_url(url)
    except (BaseError, ValueError) as error:
        raise StoreError(f"{url}: {error}; use a folder or a URL such as s3://bucket/path") from error
