"""The JSON documents of a store: a city's fixed facts, and the generations that name its tiles.

Every document is sealed: it carries the SHA-256 of its own content, and a generation that of its parent's
file. So an edited or damaged one is noticed, wherever it is in the history.
"""

import hashlib
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from presight_core.errors import InputError, StoreError
from presight_core.grid import Lattice
from presight_core.priors.schema import FEATURE_STEP, FORMAT_MINOR, FORMAT_VERSION, check_version
from presight_core.recipes import canonical_json

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")  # one folder of any file system or object store, never ".."
VERSION = f"{FORMAT_VERSION}.{FORMAT_MINOR}"
SEAL = "sha256"  # the name under which a document carries the digest of its other names
GENERATION_FILE = re.compile(r"(\d{8})\.json")

RESTORE = "restore it from a copy of the store"

Document = TypeVar("Document")


def city_path(city: str) -> str:
    """Where a city's fixed facts are, relative to the store."""
    return f"{checked_name(city)}/city.json"


def generations_path(city: str) -> str:
    """The folder of a city's generations."""
    return f"{checked_name(city)}/generations"


def generation_path(city: str, number: int) -> str:
    """Where one generation is."""
    return f"{generations_path(city)}/{number:08d}.json"


def tag_path(city: str, tag: str) -> str:
    """Where the tag of a generation is."""
    return f"{checked_name(city)}/tags/{checked_name(tag)}.json"


def tile_path(tile_id: str, build: str) -> str:
    """Where one build of a tile is, relative to its city."""
    return f"tiles/{checked_name(tile_id)}/{checked_name(build)}"


def checked_name(name: str) -> str:
    """The name itself, if it can be one folder. Raises InputError otherwise."""
    if not NAME.fullmatch(name):
        raise InputError(f"{name!r} cannot name a folder; use letters, digits, '.', '_' and '-'")
    return name


@dataclass(frozen=True)
class CityDocument:
    """What never changes about a city's priors."""

    city: str
    lattice: Lattice
    space_id: str  # of the feature space that every tile of the city uses
    channel_count: int
    feature_step: int = FEATURE_STEP  # features are kept in steps of this / 255

    def __post_init__(self) -> None:
        if self.feature_step < 1 or 255 % self.feature_step:
            raise InputError(f"{self.city}: feature step {self.feature_step} does not divide 255; use 1, 3 or 5")

    def to_json(self) -> dict[str, Any]:
        """The document as JSON values."""
        return {
            "format_version": VERSION,
            "city": self.city,
            "lattice": lattice_to_json(self.lattice),
            "space_id": self.space_id,
            "channel_count": self.channel_count,
            "feature_step": self.feature_step,
        }

    @staticmethod
    def from_json(value: Mapping[str, Any]) -> "CityDocument":
        """The document that `to_json` wrote."""
        lattice = lattice_from_json(value["lattice"])
        channels, step = int(value["channel_count"]), int(value["feature_step"])
        return CityDocument(value["city"], lattice, value["space_id"], channels, step)


@dataclass(frozen=True)
class TileEntry:
    """What the store knows about one written build of a tile."""

    path: str  # of the Zarr group, relative to the city
    digest: str  # SHA-256 over the contents of the group's arrays
    group_sha256: str  # SHA-256 of the group's document, which holds the checksum of every chunk
    voxel_count: int
    bytes: int  # on disk
    block_count: int
    block_bounds: tuple[int, int, int, int]  # least x and y, greatest x and y of its blocks, inclusive
    space_id: str
    drives: tuple[str, ...]  # in bit order

    def to_json(self) -> dict[str, Any]:
        """The entry as JSON values."""
        return {**self.__dict__, "block_bounds": list(self.block_bounds), "drives": list(self.drives)}

    @staticmethod
    def from_json(value: Mapping[str, Any]) -> "TileEntry":
        """The entry that `to_json` wrote."""
        left, bottom, right, top = value["block_bounds"]
        known = {name: value[name] for name in TileEntry.__dataclass_fields__}
        return TileEntry(**{**known, "block_bounds": (left, bottom, right, top), "drives": tuple(value["drives"])})


@dataclass(frozen=True)
class GenerationTile:
    """The build that a generation shows for a tile, and how it came to be."""

    entry: TileEntry
    recipe: dict[str, Any]  # `Recipe.to_json` of the stage that made it
    lineage: dict[str, Any] = field(default_factory=dict)  # for people: metrics, counts, earlier artifacts

    def to_json(self) -> dict[str, Any]:
        """The tile as JSON values."""
        return {"entry": self.entry.to_json(), "recipe": self.recipe, "lineage": self.lineage}

    @staticmethod
    def from_json(value: Mapping[str, Any]) -> "GenerationTile":
        """The tile that `to_json` wrote."""
        return GenerationTile(TileEntry.from_json(value["entry"]), value["recipe"], value["lineage"])


@dataclass(frozen=True)
class Generation:
    """One consistent state of a city: the build that every tile shows. Immutable once stored."""

    number: int
    parent: int | None
    city: str
    space_id: str
    tiling: dict[str, Any]  # `Tiling.to_json` of the registry that the tiles belong to
    tiles: dict[str, GenerationTile]  # by tile id
    parent_sha256: str | None = None  # of the parent's file
    restores: int | None = None  # the earlier generation that this one equals, for a rollback
    fence: int = 0  # greatest fencing number of any publisher so far; who holds a smaller one is refused

    def to_json(self) -> dict[str, Any]:
        """The generation as JSON values."""
        return {
            "format_version": VERSION,
            "generation": self.number,
            "parent": self.parent,
            "parent_sha256": self.parent_sha256,
            "restores": self.restores,
            "city": self.city,
            "space_id": self.space_id,
            "fence": self.fence,
            "tiling": self.tiling,
            "tiles": {tile_id: tile.to_json() for tile_id, tile in sorted(self.tiles.items())},
        }

    @staticmethod
    def from_json(value: Mapping[str, Any]) -> "Generation":
        """The generation that `to_json` wrote."""
        tiles = {tile_id: GenerationTile.from_json(tile) for tile_id, tile in value["tiles"].items()}
        return Generation(
            number=int(value["generation"]),
            parent=value["parent"],
            city=value["city"],
            space_id=value["space_id"],
            tiling=value["tiling"],
            tiles=tiles,
            parent_sha256=value["parent_sha256"],
            restores=value["restores"],
            fence=value.get("fence", 0),
        )


def lattice_to_json(lattice: Lattice) -> dict[str, Any]:
    """A lattice as JSON values."""
    return {
        "origin_m": list(lattice.origin_m),
        "voxel_m": lattice.voxel_m,
        "block_columns": lattice.block_columns,
    }


def lattice_from_json(value: Mapping[str, Any]) -> Lattice:
    """The lattice that `lattice_to_json` wrote."""
    x, y, z = value["origin_m"]
    return Lattice((x, y, z), value["voxel_m"], value["block_columns"])


def encode(document: Mapping[str, Any]) -> bytes:
    """The bytes of a document, sealed: equal documents give equal bytes, and people can read them."""
    sealed = {**document, SEAL: _seal(document)}
    return (json.dumps(sealed, indent=1, sort_keys=True, allow_nan=False, ensure_ascii=False) + "\n").encode()


def decode(content: bytes, where: str, make: Callable[[Mapping[str, Any]], Document]) -> Document:
    """The document in `content`. Raises StoreError, naming `where`, if it is newer than this program or damaged."""
    try:
        value = json.loads(content)
        check_version(value["format_version"], where)
        if value.pop(SEAL) != _seal(value):
            raise StoreError(f"{where}: was edited or damaged, its seal is broken; {RESTORE}")
        return make(value)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise StoreError(f"{where}: not a valid document ({error!r}); {RESTORE}") from error


def _seal(document: Mapping[str, Any]) -> str:
    return hashlib.sha256(canonical_json(document).encode()).hexdigest()
