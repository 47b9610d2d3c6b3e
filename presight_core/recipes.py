"""Recipes: everything that determines an artifact, and the digest that names it.

A tile is stale when its published recipe differs from what today's drives, models and settings give.
That comparison is the whole of incremental mapping.
"""

import hashlib
import json
from dataclasses import dataclass
from typing import Any

WARM_START = "warm_start"  # an input: the field that a training began with, instead of random numbers
DIGEST_LENGTH = 16  # hex digits, 64 bits: collisions are out of reach for millions of artifacts


@dataclass(frozen=True)
class Recipe:
    """What one stage does: its code version, its settings and the digests of its inputs (JSON values only)."""

    stage: str
    version: int
    settings: dict[str, Any]
    inputs: dict[str, Any]

    @property
    def digest(self) -> str:
        """The artifact's name: the head of the SHA-256 of the recipe's canonical JSON."""
        return digest_of(self.to_json())

    def to_json(self) -> dict[str, Any]:
        """The recipe as JSON values."""
        return {"stage": self.stage, "version": self.version, "settings": self.settings, "inputs": self.inputs}


def aim_of(value: Any) -> Any:
    """A recipe's JSON without what its parts were begun with: what it is to be, not how it got there.

    Equal aims are equally current; the digest of the whole recipe names the artifact.
    """
    if not isinstance(value, dict):
        return value
    return {name: aim_of(part) for name, part in value.items() if name != WARM_START}


def canonical_json(value: Any) -> str:
    """JSON with sorted keys and no spaces; equal values give equal text. NaN is refused."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def digest_of(value: Any) -> str:
    """The head of the SHA-256 of a JSON value."""
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()[:DIGEST_LENGTH]


def differences(old: Any, new: Any, path: str = "") -> list[str]:
    """What changed between two JSON values, a dotted path and both values each: the reasons for being stale."""
    if old == new:
        return []
    if isinstance(old, dict) and isinstance(new, dict):
        keys = sorted(old.keys() | new.keys())
        return [line for key in keys for line in differences(old.get(key), new.get(key), f"{path}.{key}".lstrip("."))]
    if isinstance(old, list) and isinstance(new, list) and all(isinstance(item, str) for item in [*old, *new]):
        added = [f"{path}: {item} added" for item in sorted(set(new) - set(old))]
        removed = [f"{path}: {item} removed" for item in sorted(set(old) - set(new))]
        return added + removed or [f"{path}: order changed"]
    return [f"{path}: {old} -> {new}"]
