"""A JSON table as typed rows, a block at a time: a table of gigabytes is read in the memory of a few megabytes.

A table is one JSON list of objects. It is cut between two rows, `}` `,` `{`, and each piece is decoded on its own.
A wrong cut, inside a string or a nested list, leaves something open and so can never decode: then the exact place
is searched by counting brackets.
"""

import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

import msgspec

from presight_core.errors import InputError
from presight_core.progress import Progress, Report, silent

BLOCK_BYTES = 8 << 20  # about 17,000 rows of sample_data: decoding costs far more than the loop around it
ROW_BYTES = 64 << 20  # no honest row is longer; keeps a hostile table from filling the memory
BOUNDARY = re.compile(rb"\}(\s*,)\s*\{")
LAST_BYTES = 1 << 16  # where the last boundary is looked for first
COMMA = re.compile(rb"\s*,")
STRING_OR_BRACKET = re.compile(rb'"(?:[^"\\]++|\\.)*+"?|[{}\[\]]', re.DOTALL)
PLACE = re.compile(r"(?P<reason>.*) - at `\$\[(?P<row>\d+)\]\.?(?P<field>.*)`", re.DOTALL)
CURE = "copy the table again from the data set's metadata archive"

Row = TypeVar("Row", bound=msgspec.Struct)


def read_table(file: Path, row_type: type[Row], report: Report = silent) -> Iterator[list[Row]]:
    """Blocks of consecutive rows of the table in `file`; fields that `row_type` lacks are skipped.

    NaN and infinities, which JSON proper does not know, are read as such. Raises InputError, naming file and row,
    for a file that is missing, cut short, no JSON list of objects, or holds a value of the wrong type.
    """
    try:
        with file.open("rb") as source:
            yield from _Reader(file, row_type).blocks(source, report)
    except OSError as error:
        raise InputError(f"{file}: {error.strerror}; {CURE}") from error


class _Reader:
    """The state of one pass over a table."""

    def __init__(self, file: Path, row_type: type) -> None:
        self.file = file
        self.list_type = list[row_type]
        self.decoder = msgspec.json.Decoder(self.list_type)
        self.row_count = 0

    def blocks(self, source, report: Report) -> Iterator[list]:
        total = os.fstat(source.fileno()).st_size
        pending = self._after_bracket(source.read(BLOCK_BYTES))
        while more := source.read(BLOCK_BYTES):
            rows, pending = self._take(pending + more)
            if len(pending) > ROW_BYTES:
                raise self._error(f"a row of more than {ROW_BYTES >> 20} MiB")
            yield self._counted(rows)
            report(Progress(f"read {self.file.stem}", source.tell(), total))
        yield self._counted(self._last(pending))
        report(Progress(f"read {self.file.stem}", total, total))

    def _after_bracket(self, text: bytes) -> bytes:
        """The text behind the list's opening bracket; a byte order mark is passed over."""
        text = text.removeprefix(b"\xef\xbb\xbf").lstrip()
        if not text:
            raise self._error("the file is empty")
        if not text.startswith(b"["):
            raise self._error(f"not a JSON list of rows; it begins with {text[:12]!r}")
        return text[1:]

    def _take(self, text: bytes) -> tuple[list, bytes]:
        """All whole rows of `text` but perhaps the last, and the text behind them."""
        end, rest = _quick_cut(text)
        try:
            return self.decoder.decode(b"[%b]" % text[:end]), text[rest:]
        except msgspec.ValidationError as error:
            raise self._row_error(error) from None
        except (ValueError, RecursionError):
            end, rest = _exact_cut(text)
            return self._decode(b"[%b]" % text[:end]), text[rest:]

    def _last(self, text: bytes) -> list:
        """The rows up to the list's closing bracket."""
        if not text.rstrip().endswith(b"]"):
            raise self._error("the file ends in the middle")
        return self._decode(b"[" + text)

    def _decode(self, text: bytes) -> list:
        """The rows of a complete JSON list, by a slower reader that knows NaN if the strict one fails."""
        try:
            return self.decoder.decode(text)
        except msgspec.ValidationError as error:
            if "out of range" not in str(error):  # such a number is an infinity to the slower reader
                raise self._row_error(error) from None
        except (ValueError, RecursionError):
            pass
        try:
            return msgspec.convert(json.loads(text.decode()), self.list_type)
        except msgspec.ValidationError as error:
            raise self._row_error(error) from None
        except (ValueError, RecursionError) as error:
            raise self._error(f"not JSON ({error})") from None

    def _counted(self, rows: list) -> list:
        self.row_count += len(rows)
        return rows

    def _error(self, fact: str) -> InputError:
        where = f" after {self.row_count} good rows" if self.row_count else ""
        return InputError(f"{self.file}: {fact}{where}; {CURE}")

    def _row_error(self, error: msgspec.ValidationError) -> InputError:
        place = PLACE.fullmatch(str(error))
        if place is None:
            return self._error(str(error))
        row = f"row {self.row_count + int(place['row'])}"
        where = f"{row}, {place['field']}" if place["field"] else row
        return InputError(f"{self.file}: {where}: {place['reason']}; {CURE}")


def _quick_cut(text: bytes) -> tuple[int, int]:
    """Where the last row but one seems to end, and where the text behind its comma begins; (0, 0) if nowhere."""
    for start in (max(0, len(text) - LAST_BYTES), 0):
        *_, last = [None, *BOUNDARY.finditer(text, start)]
        if last is not None:
            return last.start() + 1, last.end(1)
    return 0, 0


def _exact_cut(text: bytes) -> tuple[int, int]:
    """As `_quick_cut`, certain and about a hundred times slower."""
    depth, cut = 0, (0, 0)
    for match in STRING_OR_BRACKET.finditer(text):
        mark = text[match.start()]
        if mark in b"{[":
            depth += 1
        elif mark in b"}]":
            depth -= 1
            comma = COMMA.match(text, match.end()) if depth == 0 else None
            cut = (match.end(), comma.end()) if comma else cut
    return cut
