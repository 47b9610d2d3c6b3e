"""Where a field's files are, and what of it can be told without torch."""

import json
from pathlib import Path

from presight_core.errors import InputError, NotFoundError
from presight_core.tiles import SubField

FIELD_FILE = "field.safetensors"
SHAPE_FILE = "field.json"  # what the header of the other file says


def read_sub_fields(folder: Path) -> tuple[SubField, ...]:
    """The sub-fields of the field in a folder.

    Raises NotFoundError if there is no field, InputError if its description cannot be read.
    """
    file = folder / SHAPE_FILE
    if not (file.exists() and (folder / FIELD_FILE).exists()):
        raise NotFoundError(f"{folder}: no field here; train the tile")
    try:
        values = json.loads(file.read_text(encoding="utf-8"))["shape"]["sub_fields"]
        return tuple(SubField(**{name: tuple(corner) for name, corner in value.items()}) for value in values)
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{file} is damaged ({error}); delete it and train the tile from nothing") from error
