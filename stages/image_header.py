"""What can be known of an image file without decoding it: its size in pixels, and that its end is there.

JPEG: ITU-T T.81, annex B. PNG: ISO/IEC 15948, section 5. The kind is told by content, not by name.
"""

import os
import stat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

HEAD_BYTES = 4096  # holds the frame header of any image without a preview
SEGMENT_LIMIT = 256  # EXIF, previews and colour profiles take a few segments of 64 KiB; no camera writes more
TAIL_BYTES = 64  # some cameras pad the file with zeros
MAX_PIXELS = 1 << 26  # 67 megapixels; more is taken for a decompression bomb

JPEG_START, JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
PNG_START = b"\x89PNG\r\n\x1a\n"
PNG_END = b"\0\0\0\0IEND\xaeB`\x82"
FRAME_HEADERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # SOF markers; the three define other tables
DECODABLE = {0xC0, 0xC1, 0xC2}  # baseline, extended and progressive Huffman: what every decoder reads
BARE_MARKERS = frozenset([0x01, *range(0xD0, 0xD8)])  # markers without a length
COPY_AGAIN = "copy the image again from the data set's archive"
CONVERT = "convert it to an 8-bit grey or RGB JPEG or PNG"


@dataclass(frozen=True)
class ImageHeader:
    """Size of an image in pixels and of its file in bytes."""

    width_px: int
    height_px: int
    file_bytes: int


class ImageFault(Exception):
    """Why an image cannot be used: reason code, fact and cure."""

    def __init__(self, code: str, detail: str, cure: str) -> None:
        super().__init__(f"{code}: {detail}; {cure}")
        self.code, self.detail, self.cure = code, detail, cure


def read_header(file: Path | str) -> ImageHeader:
    """The header of the image in `file`. Raises ImageFault, also for anything but a regular file.

    A symbolic link as the last part of the path is not followed.
    """
    try:
        # Without O_NONBLOCK, opening a named pipe would wait for ever.
        descriptor = os.open(file, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        raise ImageFault("image-missing", "no such file", "extract the archive that holds it") from None
    except (OSError, ValueError) as error:
        raise ImageFault("image-unreadable", f"cannot be opened ({error})", "make the file readable") from None
    try:
        return _header(descriptor)
    except OSError as error:
        raise ImageFault("image-unreadable", f"cannot be read ({error.strerror})", "check the disk") from None
    finally:
        os.close(descriptor)


def _header(descriptor: int) -> ImageHeader:
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode):
        raise ImageFault("image-unreadable", "not a regular file", COPY_AGAIN)
    head = os.pread(descriptor, HEAD_BYTES, 0)
    tail = os.pread(descriptor, TAIL_BYTES, max(0, status.st_size - TAIL_BYTES)).rstrip(b"\0")
    if head.startswith(JPEG_START):
        is_whole = tail.endswith(JPEG_END)
        width_px, height_px = _jpeg_size(lambda start, count: os.pread(descriptor, count, start), head)
    elif head.startswith(PNG_START):
        is_whole = tail.endswith(PNG_END)
        width_px, height_px = _png_size(head)
    else:
        raise _broken(f"neither JPEG nor PNG: {status.st_size} bytes, beginning with {head[:4].hex() or 'nothing'}")
    if not is_whole:
        raise _broken(f"the image has no end: cut short at {status.st_size} bytes")
    if width_px * height_px > MAX_PIXELS:
        raise ImageFault("image-huge", f"{width_px} x {height_px} pixels", f"scale it below {MAX_PIXELS} pixels")
    return ImageHeader(width_px, height_px, status.st_size)


def _broken(detail: str) -> ImageFault:
    return ImageFault("image-broken", detail, COPY_AGAIN)


def _jpeg_size(read: Callable[[int, int], bytes], head: bytes) -> tuple[int, int]:
    """Width and height from the frame header, found by stepping over the segments before it."""
    position = 2  # behind the start marker
    for _ in range(SEGMENT_LIMIT):
        segment = head[position : position + 10]
        if len(segment) < 10:
            segment = read(position, 10)
        if len(segment) < 10 or segment[0] != 0xFF:
            break
        marker = segment[1]
        if marker in FRAME_HEADERS:
            return _frame_size(marker, segment)
        if marker == 0xFF:  # padding
            position += 1
        elif marker in BARE_MARKERS:
            position += 2
        else:
            position += 2 + int.from_bytes(segment[2:4], "big")
    raise _broken("a JPEG without a frame header")


def _frame_size(marker: int, segment: bytes) -> tuple[int, int]:
    bits, channel_count = segment[4], segment[9]
    if marker not in DECODABLE or bits != 8 or channel_count not in (1, 3):
        kind = f"JPEG of process {marker - 0xC0}, {bits} bits, {channel_count} channels"
        raise ImageFault("image-format", kind, CONVERT)
    return int.from_bytes(segment[7:9], "big"), int.from_bytes(segment[5:7], "big")


def _png_size(head: bytes) -> tuple[int, int]:
    if head[12:16] != b"IHDR" or len(head) < 26:
        raise _broken("a PNG without a header")
    if head[24] == 16:
        raise ImageFault("image-format", "PNG of 16 bits", CONVERT)
    return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
