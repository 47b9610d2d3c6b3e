"""Files that are there as a whole or not at all."""

import json
import os
import threading
from pathlib import Path


def write_whole(path: Path, content: bytes) -> None:
    """Replace a file as a whole, so that nobody ever reads half of it; its folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}")
    unfinished.write_bytes(content)
    unfinished.replace(path)


def write_json(path: Path, content: object) -> None:
    """Replace a JSON file as a whole."""
    write_whole(path, json.dumps(content, indent=0).encode())
