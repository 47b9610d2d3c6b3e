"""Where the store writes: a folder or an object-store URL, through obstore."""

import shutil
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
from storage.folders import create_file, force_to_disk, force_tree_to_disk


def open_store(location: str | Path) -> ObjectStore:
    """The object store at a folder, made if absent, or at a URL. Raises StoreError if it cannot be had."""
    folder = local_folder(location)
    with storing(str(location)):
        if folder is None:
            return obstore.store.from_url(str(location))
        folder.mkdir(parents=True, exist_ok=True)
        return LocalStore(folder.resolve())


def put_once(store: ObjectStore, path: str, content: bytes) -> bool:
    """Create an object, or leave the one that is there: False. At most one of many writers sees True.

    What is there when this returns survives a loss of power.
    """
    with storing(path):
        failpoint("store-before-put")
        is_new = _create(store, path, content)
        settle(store, path)
        failpoint("store-after-put")
        return is_new


def _create(store: ObjectStore, path: str, content: bytes) -> bool:
    if isinstance(store, LocalStore):  # which names a file before its content is on the disk
        return create_file(_folder(store) / path, content)
    try:
        obstore.put(store, path, content, mode="create")
    except AlreadyExistsError:
        return False
    return True


def settle(store: ObjectStore, path: str) -> None:
    """Make a folder, or the names that lead to an object, survive a loss of power; object stores do by themselves."""
    if not isinstance(store, LocalStore):
        return
    with storing(path):
        place = _folder(store) / path
        if place.is_dir():
            force_tree_to_disk(place)
        for parent in Path(path).parents:
            force_to_disk(_folder(store) / parent)


def exists(store: ObjectStore, path: str) -> bool:
    """Whether there is an object at the path."""
    with storing(path):
        try:
            obstore.head(store, path)
        except FileNotFoundError:
            return False
        return True


def remove(store: ObjectStore, path: str) -> None:
    """Delete an object; it does not come back with a loss of power."""
    with storing(path):
        failpoint("store-before-delete")
        obstore.delete(store, path)
        settle(store, path)
        failpoint("store-after-delete")


def remove_group(store: ObjectStore, folder: str) -> None:
    """Delete a build of a tile, if there is one: its document first, so that half a build never looks whole."""
    paths = [entry.path for entry in objects(store, folder)]
    with storing(folder):
        if f"{folder}/zarr.json" in paths:
            remove(store, f"{folder}/zarr.json")
        failpoint("group-half-deleted")
        if not isinstance(store, LocalStore):
            obstore.delete(store, [path for path in paths if path != f"{folder}/zarr.json"])
        elif (_folder(store) / folder).is_dir():
            shutil.rmtree(_folder(store) / folder)  # and its folders, of which there is one a chunk


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


def _folder(store: LocalStore) -> Path:
    assert store.prefix is not None, "every store of ours is opened at a folder"
    return Path(store.prefix)


@contextmanager
def storing(what: str) -> Iterator[None]:
    """Turns failures of disks and object stores into a StoreError that names what was stored."""
    try:
        yield
    except (OSError, BaseError) as error:
        cure = "check the location, the free space and your access to it, then run again"
        raise StoreError(f"{what}: {error}; {cure}") from error
