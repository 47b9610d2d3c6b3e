"""Where the store writes: a folder or an object-store URL, through obstore."""

from collections.abc import Iterator
from contextlib import contextmanager
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


def remove_all(store: ObjectStore, folder: str) -> None:
    """Delete every object under a folder."""
    with storing(folder):
        for objects in obstore.list(store, folder):
            obstore.delete(store, [entry["path"] for entry in objects])


def size_bytes(store: ObjectStore, folder: str) -> int:
    """Bytes of all objects under a folder."""
    with storing(folder):
        return sum(entry["size"] for objects in obstore.list(store, folder) for entry in objects)


@contextmanager
def storing(what: str) -> Iterator[None]:
    """Turns failures of disks and object stores into a StoreError that names what was stored."""
    try:
        yield
    except (OSError, BaseError) as error:
        cure = "check the location, the free space and your access to it, then run again"
        raise StoreError(f"{what}: {error}; {cure}") from error
