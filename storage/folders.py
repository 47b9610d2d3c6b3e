"""Writing a whole folder or none of it: into a hidden neighbour, forced to the disk, then renamed."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

from presight_core.failpoints import failpoint


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
        _force_tree_to_disk(temporary)
        failpoint("folder-before-rename")
        _rename(temporary, final)
        failpoint("folder-after-rename")
        force_to_disk(final.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _rename(temporary: Path, final: Path) -> None:
    try:
        temporary.rename(final)
    except OSError:
        if not final.is_dir():
            raise


def _force_tree_to_disk(folder: Path) -> None:
    """Make all files of a folder survive a loss of power, before its rename can."""
    for parent, _, files in os.walk(folder):
        for name in [*files, ""]:  # "" is the folder's own list of names
            force_to_disk(Path(parent) / name)


def force_to_disk(path: Path) -> None:
    """Make a file's content, or a folder's list of names, survive a loss of power."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
