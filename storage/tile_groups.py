"""Writes one build of a tile: an immutable Zarr group, streamed from batches of voxels."""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import obstore
from numpy.typing import NDArray
from obstore.store import ObjectStore

from presight_core.errors import ConflictError
from presight_core.failpoints import failpoint
from presight_core.grid import morton
from presight_core.priors.chunks import array_document, chunk_checksum, chunk_path, encode_chunk
from presight_core.priors.documents import VERSION, CityDocument, TileEntry, lattice_to_json, tile_path
from presight_core.priors.schema import ArraySpec, VoxelBatch, array_specs, check_batch, pack_features
from presight_core.recipes import canonical_json
from storage.location import exists, put_once, remove_group, settle, size_bytes, storing

SLAB_CHUNKS = 32  # written at once, so that they are compressed and sent side by side: 4 MB of features
MOST_WRITES = 8  # at once: hides the latency of an object store


@dataclass(frozen=True)
class TileName:
    """Which tile, and under which name its build is kept; a build name is used once."""

    tile_id: str
    build: str


def write_group(
    store: ObjectStore,
    city: CityDocument,
    name: TileName,
    batches: Iterable[VoxelBatch],
    drives: Sequence[str],
    attributes: Mapping[str, Any],
) -> TileEntry:
    """Write a tile from batches in Morton order; `drives` in bit order; `attributes` are JSON values for people.

    The group document is created last: a group without one is a write that did not finish, and is cleared.
    Memory is bounded by the largest batch and one slab per array. Raises ConflictError if the build is there,
    StoreError if it cannot be stored.
    """
    path = tile_path(name.tile_id, name.build)
    root = f"{city.city}/{path}"
    _clear_unfinished(store, root)
    specs = array_specs(city.channel_count, len(drives), city.lattice.block_columns)
    extent = _Extent()
    with ThreadPoolExecutor(MOST_WRITES) as pool:
        writers = {key: _ArrayWriter(store, f"{root}/{key}", spec, pool) for key, spec in specs.items()}
        for batch in batches:
            check_batch(batch, specs)
            for key, writer in writers.items():
                writer.append(_stored_rows(key, batch, extent.voxel_count, city.feature_step))
            extent.add(batch)
        writers["block_start"].append(np.array([extent.voxel_count], np.int64))
        contents = {key: writer.finish() for key, writer in writers.items()}
    counts = {"voxel_count": extent.voxel_count, "block_count": extent.block_count, "digest": contents_digest(contents)}
    facts = _facts(city, name, drives) | counts | {"arrays": contents}
    document = _finish(store, root, {**attributes, **facts})
    return TileEntry(
        **counts,
        group_sha256=hashlib.sha256(document).hexdigest(),
        path=path,
        bytes=size_bytes(store, root),
        block_bounds=extent.bounds,
        space_id=city.space_id,
        drives=tuple(drives),
    )


def contents_digest(arrays: Mapping[str, Mapping[str, Any]]) -> str:
    """One SHA-256 for the contents of all arrays, however they are chunked and compressed."""
    contents = {name: {key: facts[key] for key in ("dtype", "shape", "sha256")} for name, facts in arrays.items()}
    return hashlib.sha256(canonical_json(contents).encode()).hexdigest()


def _stored_rows(key: str, batch: VoxelBatch, first_row: int, feature_step: int) -> NDArray:
    """A batch's part of an array, as it is stored; the batch's first voxel becomes row `first_row`."""
    if key == "block_start":
        return batch.block_start[:-1] + first_row
    return pack_features(batch.features, feature_step) if key == "features" else getattr(batch, key)


@dataclass
class _Extent:
    """How many voxels and blocks were written, and between which blocks."""

    voxel_count: int = 0
    block_count: int = 0
    bounds: tuple[int, int, int, int] = (0, 0, 0, 0)
    last_key: int = -1

    def add(self, batch: VoxelBatch) -> None:
        if not len(batch.block_index):
            return
        keys = morton(batch.block_index)
        assert int(keys[0]) > self.last_key, "batches ascend in Morton order"
        self.last_key = int(keys[-1])
        corners = [batch.block_index] + ([np.reshape(self.bounds, (2, 2))] if self.block_count else [])
        blocks = np.concatenate(corners)
        (left, bottom), (right, top) = blocks.min(0).tolist(), blocks.max(0).tolist()
        self.bounds = (left, bottom, right, top)
        self.voxel_count += len(batch.voxel)
        self.block_count += len(batch.block_index)


@dataclass
class _ArrayWriter:
    """Appends rows to one array, a slab of whole chunks at a time, and hashes them on the way."""

    store: ObjectStore
    path: str
    spec: ArraySpec
    pool: ThreadPoolExecutor
    pending: list[NDArray] = field(default_factory=list)
    pending_rows: int = 0
    row_count: int = 0
    checksums: list[int] = field(default_factory=list)  # crc32c of every chunk written
    stored_bytes: int = 0
    digest: Any = field(default_factory=hashlib.sha256)

    def append(self, rows: NDArray) -> None:
        self.pending.append(rows)
        self.pending_rows += len(rows)
        slab_rows = SLAB_CHUNKS * self.spec.chunk_rows
        if self.pending_rows >= slab_rows:
            waiting = np.concatenate(self.pending)
            whole = len(waiting) // slab_rows * slab_rows
            self._write(waiting[:whole])
            self.pending, self.pending_rows = [waiting[whole:].copy()], len(waiting) - whole

    def finish(self) -> dict[str, Any]:
        """Write what is left and the array's document; what the group's document says about the array."""
        if self.pending_rows:
            self._write(np.concatenate(self.pending))
        self._put("zarr.json", json.dumps(array_document(self.spec, self.row_count)).encode())
        return {
            "dtype": self.spec.dtype,
            "shape": [self.row_count, *self.spec.row_shape],
            "sha256": self.digest.hexdigest(),
            "chunk_rows": self.spec.chunk_rows,
            "crc32c": self.checksums,
        }

    def _write(self, rows: NDArray) -> None:
        """Store rows, of which all but the last ones of the array fill whole chunks; chunks go side by side."""
        self.digest.update(np.ascontiguousarray(rows).astype(rows.dtype.newbyteorder("<"), copy=False).data)
        self.row_count += len(rows)
        size = self.spec.chunk_rows
        failpoint("slab-before-write")
        pieces = [rows[first : first + size] for first in range(0, len(rows), size)]
        numbers = range(len(self.checksums), len(self.checksums) + len(pieces))
        self.checksums += self.pool.map(self._write_chunk, pieces, numbers)

    def _write_chunk(self, rows: NDArray, number: int) -> int:
        content = encode_chunk(rows, self.spec)
        self._put(chunk_path(number, self.spec), content)
        return chunk_checksum(content)

    def _put(self, name: str, content: bytes) -> None:
        with storing(f"{self.path}/{name}"):
            obstore.put(self.store, f"{self.path}/{name}", content)


def _clear_unfinished(store: ObjectStore, root: str) -> None:
    if exists(store, f"{root}/zarr.json"):
        raise ConflictError(f"{root} was written before; give the new build a name of its own")
    remove_group(store, root)


def _facts(city: CityDocument, name: TileName, drives: Sequence[str]) -> dict[str, Any]:
    return {
        "format_version": VERSION,
        "city": city.city,
        "lattice": lattice_to_json(city.lattice),
        "space_id": city.space_id,
        "feature_step": city.feature_step,
        "tile_id": name.tile_id,
        "build": name.build,
        "drives": list(drives),
    }


def _finish(store: ObjectStore, root: str, attributes: dict[str, Any]) -> bytes:
    document = {"zarr_format": 3, "node_type": "group", "attributes": attributes}
    content = json.dumps(document, allow_nan=False).encode()
    settle(store, root)  # the document must not name chunks that are not on the disk
    if not put_once(store, f"{root}/zarr.json", content):
        raise ConflictError(f"{root} was written by somebody else meanwhile; give the new build a name of its own")
    return content
