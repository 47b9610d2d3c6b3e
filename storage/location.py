"""Where the store writes: a folder or an object-store URL, through obstore."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from operator import attrgetter
from pathlib import Path

import obstore
from obstore.exceptions import AlreadyExistsError, BaseError
from obstore.store import LocalStore, ObjectStore

from presight_core.errors import StoreError
from presight_core.failpoints import failpoint
from presight_core.priors.location import local_folder


def open_store(location: str | Path) -> ObjectStore:
    """The object store at a folder, made if absent, or at a URL. Raises StoreError if it cannot be had."""
    folder = local_folder(location)
    with storing(str(location)):
        if folder is None:
            return obstore.store.from_url(str(location))
        folder.mkdir(parents=True, exist_ok=True)
        return LocalStore(folder.resolve())


def put_once(store: ObjectStore, path: str, content: bytes) -> bool:
    """Create an object, or leave the one that is there: False. At most one of many writers sees True."""
    with storing(path):
        failpoint("store-before-put")
        try:
            obstore.put(store, path, content, mode="create")
        except AlreadyExistsError:
            return False
        failpoint("store-after-put")
        return True


def exists(store: ObjectStore, path: str) -> bool:
    """Whether there is an object at the path."""
    with storing(path):
        try:
            obstore.head(store, path)
        except FileNotFoundError:
            return False
        return True


def remove(store: ObjectStore, paths: list[str]) -> None:
    """Delete objects."""
    with storing(paths[0] if paths else ""):
        obstore.delete(store, paths)


def remove_all(store: ObjectStore, folder: str) -> None:
    """Delete every object under a folder."""
    remove(store, [entry.path for entry in objects(store, folder)])


@dataclass(frozen=True)
class StoredObject:
    """One object of the store."""

    path: str
    size: int  # bytes
    modified: datetime


def objects(store: ObjectStore, folder: str) -> list[StoredObject]:
    """Every object under a folder, by path."""
    with storing(folder):
        found = [entry for entries in obstore.list(store, folder) for entry in entries]
    return sorted(
        (StoredObject(entry["path"], entry["size"], entry["last_modified"]) for entry in found), key=attrgetter("path")
    )


def size_bytes(store: ObjectStore, folder: str) -> int:
    """Bytes of all objects under a folder."""
    return sum(entry.size for entry in objects(store, folder))


@contextmanager
def storing(what: str) -> Iterator[None]:
    """Turns failures of disks and object stores into a StoreError that names what was stored."""
    try:
        yield
    except (OSError, BaseError) as error:
        cure = "check the location, the free space and your access to it, then run again"
        raise StoreError(f"{what}: {error}; {cure}") from error
