"""Writing a whole folder or file, or none of it: into a neighbour, forced to the disk, then named."""

import os
import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

from presight_core.failpoints import failpoint

MOST_AT_ONCE = 8  # files on their way to the disk: the disk takes them together, seven times faster than one by one


@contextmanager
def whole_folder(final: Path) -> Iterator[Path]:
    """A temporary folder to fill; it becomes `final` if the block ends well, and vanishes otherwise.

    Where another process made `final` meanwhile, that one is kept: same name, same content.
    """
    final.parent.mkdir(parents=True, exist_ok=True)
    temporary = final.with_name(f".{final.name}-{uuid4().hex}.part")
    temporary.mkdir()
    try:
        yield temporary
        force_tree_to_disk(temporary)
        failpoint("folder-before-rename")
        _rename(temporary, final)
        failpoint("folder-after-rename")
        force_to_disk(final.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def create_file(final: Path, content: bytes) -> bool:
    """Create a file, or leave the one that is there: False. Either way it survives a loss of power.

    At most one of many writers sees True. Nobody ever sees a part of it: it is named when it is on the disk.
    """
    final.parent.mkdir(parents=True, exist_ok=True)
    part = final.with_name(f"{final.name}#{uuid4().int}")  # after a # and digits, obstore lists it no more than its own
    try:
        part.write_bytes(content)
        force_to_disk(part)
        failpoint("file-before-link")
        os.link(part, final)  # fails where the name is taken
    except FileExistsError:
        return False
    finally:
        part.unlink(missing_ok=True)
        force_to_disk(final.parent)
    return True


def _rename(temporary: Path, final: Path) -> None:
    try:
        temporary.rename(final)
    except OSError:
        if not final.is_dir():
            raise


def force_tree_to_disk(folder: Path) -> None:
    """Make all files of a folder survive a loss of power, before what names it can."""
    walk = os.walk(folder)
    paths = [Path(parent) / name for parent, _, files in walk for name in [*files, ""]]  # "": its own list of names
    with ThreadPoolExecutor(MOST_AT_ONCE) as pool:
        list(pool.map(force_to_disk, paths))


def force_to_disk(path: Path) -> None:
    """Make a file's content, or a folder's list of names, survive a loss of power."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
