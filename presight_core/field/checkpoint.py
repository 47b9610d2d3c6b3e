"""Fields and training states on disk: safetensors, each file replaced in one step.

A safetensors header holds the JSON that describes the tensors, so one rename commits both. The `.json`
beside a field is a copy for people and for plans.
"""

import json
import os
import struct
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import safetensors
import torch
from torch import Tensor

from presight_core.errors import InputError, NotFoundError
from presight_core.field.files import FIELD_FILE, SHAPE_FILE
from presight_core.field.tile_field import FieldShape, TileField

TYPE_NAMES = {torch.float32: "F32", torch.int64: "I64"}  # parameters and optimisers hold no others
FIELD_VERSION = 1  # of the parameters' names and meaning


def save_field(folder: Path, field: TileField) -> None:
    """Write a field's parameters and shape into a folder, made if need be."""
    header = {"version": FIELD_VERSION, "shape": field.shape.to_json()}
    save_tensors(folder / FIELD_FILE, dict(field.state_dict()), header)
    _replace(folder / SHAPE_FILE, lambda file: file.write_text(json.dumps(header, indent=2), encoding="utf-8"))


def load_field(folder: Path, device: str = "cpu") -> TileField:
    """The field that `save_field` wrote.

    Raises NotFoundError if there is none, InputError if it is damaged or of another version.
    """
    tensors, header = load_tensors(folder / FIELD_FILE, device)
    if header.get("version") != FIELD_VERSION:
        found = header.get("version")
        raise InputError(f"{folder / FIELD_FILE}: version {found}, this program reads {FIELD_VERSION}; train it again")
    field = TileField(FieldShape.from_json(header["shape"]))
    field.load_state_dict(tensors)
    return field.to(device).eval()


def save_tensors(file: Path, tensors: Mapping[str, Tensor], header: dict[str, Any]) -> None:
    """Write tensors and a JSON header to one file: wholly, or not at all.

    One tensor after the other comes from its device: a large tile's optimiser state need not fit into memory.
    """
    entries: dict[str, Any] = {"__metadata__": {"header": json.dumps(header)}}
    end = 0
    for name, tensor in tensors.items():
        start, end = end, end + tensor.numel() * tensor.element_size()
        kind = TYPE_NAMES[tensor.dtype]
        entries[name] = {"dtype": kind, "shape": list(tensor.shape), "data_offsets": [start, end]}
    text = json.dumps(entries).encode()
    text += b" " * (-len(text) % 8)  # so that the tensors are aligned
    _replace(file, lambda partial: _write(partial, text, tensors.values()))


def load_tensors(file: Path, device: str = "cpu") -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and header of a file that `save_tensors` wrote.

    Raises NotFoundError if it is absent, InputError if it cannot be read.
    """
    if not file.exists():
        raise NotFoundError(f"{file} does not exist; train the tile first")
    try:
        with safetensors.safe_open(file, framework="pt", device=device) as opened:
            header = json.loads((opened.metadata() or {})["header"])
            return {name: opened.get_tensor(name) for name in opened.keys()}, header  # noqa: SIM118 - not a dict
    except (safetensors.SafetensorError, KeyError, ValueError) as error:
        raise InputError(f"{file} is damaged ({error}); delete it and train the tile again") from error


def _write(file: Path, header: bytes, tensors: Iterable[Tensor]) -> None:
    """The format of safetensors: the header's length, the header, the tensors."""
    with file.open("wb") as stream:
        stream.write(struct.pack("<Q", len(header)))
        stream.write(header)
        for tensor in tensors:
            tensor.detach().cpu().contiguous().numpy().tofile(stream)


def _replace(file: Path, write: Any) -> None:
    """Let `write` fill a file beside `file`, make it durable, and put it in place in one step."""
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_name(f"{file.name}.partial")
    write(partial)
    _flush(partial, os.O_RDWR)
    partial.replace(file)
    _flush(file.parent, os.O_RDONLY)


def _flush(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
