"""Tables are read the same whatever their layout and wherever the blocks end."""

import json
import math

import msgspec
import pytest

from presight_core import table
from presight_core.errors import InputError
from presight_core.table import read_table


class Row(msgspec.Struct):
    """Part of a row."""

    number: float
    text: str = ""


NASTY = ["plain", "},{", '}, {"number": 1}, {', "\\", '"', '\\"},\n{', "[}]", "ü\u2028"]


@pytest.fixture
def write(tmp_path):
    def write(content: str | bytes):
        file = tmp_path / "rows.json"
        file.write_bytes(content if isinstance(content, bytes) else content.encode())
        return file

    return write


def read(file) -> list[Row]:
    return [row for block in read_table(file, Row) for row in block]


@pytest.mark.parametrize("layout", [{"indent": None}, {"indent": 0}, {"indent": 2}, {"separators": (",", ":")}])
@pytest.mark.parametrize("block_bytes", [1, 7, 100, 1 << 20])
def test_rows_survive_any_layout_and_any_block_size(write, monkeypatch, layout, block_bytes):
    monkeypatch.setattr(table, "BLOCK_BYTES", block_bytes)
    rows = [{"number": n, "text": NASTY[n % len(NASTY)], "skipped": [{"a": "},{"}, {"b": n}]} for n in range(40)]
    assert read(write(json.dumps(rows, **layout))) == [Row(row["number"], row["text"]) for row in rows]


def test_a_table_comes_in_blocks_that_are_smaller_than_the_file(write, monkeypatch):
    monkeypatch.setattr(table, "BLOCK_BYTES", 256)
    blocks = list(read_table(write(json.dumps([{"number": n} for n in range(1000)])), Row))
    assert max(map(len, blocks)) < 40


def test_nan_and_infinities_are_read_as_numbers(write):
    numbers = [row.number for row in read(write('[{"number": NaN}, {"number": -Infinity}, {"number": 1e999}]'))]
    assert math.isnan(numbers[0])
    assert numbers[1:] == [-math.inf, math.inf]


def test_a_byte_order_mark_is_passed_over(write):
    assert read(write(b'\xef\xbb\xbf [{"number": 1}]\n')) == [Row(1)]


def test_an_empty_list_has_no_rows(write):
    assert read(write("[\n]")) == []


BROKEN = {
    "empty": (b"", "the file is empty"),
    "object": (b'{"number": 1}', "not a JSON list"),
    "UTF-16": ('[{"number": 1}]'.encode("utf-16"), "not a JSON list"),
    "cut short": (b'[{"number": 1}, {"num', "ends in the middle"),
    "cut after a row": (b'[{"number": 1}', "ends in the middle"),
    "missing comma": (b'[{"number": 1} {"number": 2}]', "not JSON"),
    "trailing comma": (b'[{"number": 1},]', "not JSON"),
    "text behind": (b'[{"number": 1}] []', "not JSON"),
    "two lists": (b'[{"number": 1}][{"number": 2}]', "not JSON"),
    "no UTF-8": (b'[{"number": 1, "text": "\xff"}]', "not JSON"),
    "deep": (b'[{"x": ' + b"[" * 3000 + b"]", "not JSON"),
    "list of lists": (b"[[1]]", "row 0: Expected `object`"),
    "wrong type": (b'[{"number": 1}, {"number": "1"}]', "row 1, number: Expected `float`"),
}


@pytest.mark.parametrize("kind", BROKEN)
@pytest.mark.parametrize("block_bytes", [4, 1 << 20])
def test_what_is_no_table_is_refused_with_file_and_fact(write, monkeypatch, kind, block_bytes):
    monkeypatch.setattr(table, "BLOCK_BYTES", block_bytes)
    content, fact = BROKEN[kind]
    with pytest.raises(InputError) as caught:
        read(file := write(content))
    assert str(caught.value).startswith(f"{file}: ")
    assert fact in str(caught.value)


def test_the_row_at_fault_is_counted_across_blocks(write, monkeypatch):
    monkeypatch.setattr(table, "BLOCK_BYTES", 64)
    rows = [{"number": n} for n in range(100)]
    rows[77]["number"] = "seventy-seven"
    with pytest.raises(InputError, match="row 77, number"):
        read(write(json.dumps(rows)))


def test_a_row_without_end_is_refused_before_it_fills_the_memory(write, monkeypatch):
    monkeypatch.setattr(table, "BLOCK_BYTES", 1000)
    monkeypatch.setattr(table, "ROW_BYTES", 5000)
    with pytest.raises(InputError, match="a row of more than"):
        read(write('[{"number": 1, "text": "' + "x" * 100_000 + '"}]'))
