"""The images of a data set's root, checked many at a time; nothing outside the root is ever opened."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from stages.image_header import ImageFault, read_header

THREADS = 8  # the checks wait for the disk, not for the processor
IMAGES_A_TASK = 64  # handing a single image to a thread costs more than its check
INSIDE = "store the file inside the root and name it by a plain relative path"


@dataclass(frozen=True)
class ExpectedImage:
    """An image file as the tables describe it; the path is relative to the root and not to be trusted."""

    path: str
    width_px: int
    height_px: int


def printable(path: str) -> str:
    """The path fit for a one-line message."""
    return path if path.isprintable() else ascii(path)


class ImageFolder:
    """The root of a data set. Use as a context manager: it owns threads."""

    def __init__(self, root: Path) -> None:
        self._root = os.path.realpath(root)
        self._folders: dict[str, str] = {}  # real path by relative path, of folders found to lie inside the root
        self._pool = ThreadPoolExecutor(THREADS, "image-check")

    def __enter__(self) -> "ImageFolder":
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def check_all(self, images: Sequence[ExpectedImage]) -> list[int | ImageFault]:
        """The file size in bytes of each image, or what is wrong with it."""
        tasks = [images[start : start + IMAGES_A_TASK] for start in range(0, len(images), IMAGES_A_TASK)]
        return [result for results in self._pool.map(self._check_some, tasks) for result in results]

    def _check_some(self, images: Sequence[ExpectedImage]) -> list[int | ImageFault]:
        return [self.check(image) for image in images]

    def check(self, image: ExpectedImage) -> int | ImageFault:
        """The file size in bytes of one image, or what is wrong with it."""
        try:
            header = read_header(self._file(image.path))
        except ImageFault as fault:
            return fault
        if (header.width_px, header.height_px) != (image.width_px, image.height_px):
            said = f"the table says {image.width_px} x {image.height_px}"
            detail = f"the image has {header.width_px} x {header.height_px} pixels, {said}"
            return ImageFault("image-size", detail, "correct sample_data.json, or restore the image")
        return header.file_bytes

    def _file(self, path: str) -> str:
        """The file to open for a path of the tables. Raises ImageFault if it leads out of the root."""
        folder, _, name = path.rpartition("/")
        if path.startswith("/") or ".." in path.split("/") or not name or not path.isprintable():
            raise ImageFault("path-unsafe", "the path is not a plain relative one", INSIDE)
        file = os.path.join(self._real_folder(folder), name)  # noqa: PTH118 - a million Paths cost seconds
        if not os.path.islink(file):  # noqa: PTH114
            return file
        return self._inside(os.path.realpath(file))

    def _real_folder(self, folder: str) -> str:
        if folder not in self._folders:
            self._folders[folder] = self._inside(os.path.realpath(os.path.join(self._root, folder)))  # noqa: PTH118
        return self._folders[folder]

    def _inside(self, real_path: str) -> str:
        if real_path != self._root and not real_path.startswith(self._root.rstrip("/") + "/"):
            raise ImageFault("path-unsafe", f"a symbolic link leads out of the root, to {real_path}", INSIDE)
        return real_path
