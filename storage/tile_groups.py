"""Writes one build of a tile: an immutable Zarr group, streamed from batches of voxels."""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from obstore.store import ObjectStore
from zarr.codecs import BloscCodec, Crc32cCodec
from zarr.core.buffer import Buffer
from zarr.storage import ObjectStore as ZarrStore
from zarr.storage import WrapperStore

from presight_core.errors import ConflictError
from presight_core.failpoints import failpoint
from presight_core.grid import morton
from presight_core.priors.documents import CityDocument, TileEntry, lattice_to_json, tile_path
from presight_core.priors.schema import (
    FORMAT_MINOR,
    FORMAT_VERSION,
    ArraySpec,
    VoxelBatch,
    array_specs,
    check_batch,
)
from presight_core.recipes import canonical_json
from storage.location import exists, put_once, remove_all, size_bytes, storing

SLAB_CHUNKS = 16  # written at once, so that they are compressed in parallel: 16 MB of features
COMPRESSION_LEVEL = 3  # zstd's own default


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
    writers = {key: _ArrayWriter.create(store, f"{root}/{key}", spec) for key, spec in specs.items()}
    extent = _Extent()
    for batch in batches:
        check_batch(batch, specs)
        for key, writer in writers.items():
            writer.append(getattr(batch, key) if key != "block_start" else batch.block_start[:-1] + extent.voxel_count)
        extent.add(batch)
    writers["block_start"].append(np.array([extent.voxel_count], np.int64))
    contents = {key: writer.finish() for key, writer in writers.items()}
    entry = {"voxel_count": extent.voxel_count, "block_count": extent.block_count, "digest": _digest(contents)}
    facts = _facts(city, name, drives) | entry | {"arrays": contents}
    _finish(store, root, {**attributes, **facts})
    return TileEntry(
        **entry,
        path=path,
        bytes=size_bytes(store, root),
        block_bounds=extent.bounds,
        space_id=city.space_id,
        drives=tuple(drives),
    )


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

    array: zarr.Array
    slab_rows: int
    digest: Any
    pending: list[NDArray] = field(default_factory=list)
    pending_rows: int = 0

    @staticmethod
    def create(store: ObjectStore, path: str, spec: ArraySpec) -> "_ArrayWriter":
        itemsize = np.dtype(spec.dtype).itemsize
        with storing(path):
            array = zarr.create_array(
                _ArraysOnly(ZarrStore(store)),
                name=path,
                shape=(0, *spec.row_shape),
                chunks=(spec.chunk_rows, *spec.row_shape),
                dtype=spec.dtype,
                fill_value=0,
                compressors=[
                    BloscCodec(cname="zstd", clevel=COMPRESSION_LEVEL, shuffle="shuffle", typesize=itemsize),
                    Crc32cCodec(),
                ],
                config={"write_empty_chunks": True},  # so that an absent chunk is always a lost one
            )
        return _ArrayWriter(array, SLAB_CHUNKS * spec.chunk_rows, hashlib.sha256())

    def append(self, rows: NDArray) -> None:
        self.pending.append(rows)
        self.pending_rows += len(rows)
        if self.pending_rows >= self.slab_rows:
            waiting = np.concatenate(self.pending)
            whole = len(waiting) // self.slab_rows * self.slab_rows
            self._write(waiting[:whole])
            self.pending, self.pending_rows = [waiting[whole:].copy()], len(waiting) - whole

    def finish(self) -> dict[str, Any]:
        """Write what is left; the array's dtype, shape and SHA-256."""
        if self.pending_rows:
            self._write(np.concatenate(self.pending))
        return {"dtype": str(self.array.dtype), "shape": list(self.array.shape), "sha256": self.digest.hexdigest()}

    def _write(self, rows: NDArray) -> None:
        first = self.array.shape[0]
        self.digest.update(np.ascontiguousarray(rows).astype(rows.dtype.newbyteorder("<"), copy=False).data)
        with storing(self.array.path):
            failpoint("slab-before-write")
            self.array.resize((first + len(rows), *self.array.shape[1:]))
            self.array[first:] = rows


class _ArraysOnly(WrapperStore[ZarrStore]):
    """Zarr would make a group document of every folder above an array; ours is made last, and says "finished"."""

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        return None


def _clear_unfinished(store: ObjectStore, root: str) -> None:
    if exists(store, f"{root}/zarr.json"):
        raise ConflictError(f"{root} was written before; give the new build a name of its own")
    remove_all(store, root)


def _facts(city: CityDocument, name: TileName, drives: Sequence[str]) -> dict[str, Any]:
    return {
        "format_version": f"{FORMAT_VERSION}.{FORMAT_MINOR}",
        "city": city.city,
        "lattice": lattice_to_json(city.lattice),
        "space_id": city.space_id,
        "tile_id": name.tile_id,
        "build": name.build,
        "drives": list(drives),
    }


def _digest(contents: Mapping[str, Any]) -> str:
    """One SHA-256 for the contents of all arrays, however they are chunked and compressed."""
    return hashlib.sha256(canonical_json(contents).encode()).hexdigest()


def _finish(store: ObjectStore, root: str, attributes: dict[str, Any]) -> None:
    document = {"zarr_format": 3, "node_type": "group", "attributes": attributes}
    if not put_once(store, f"{root}/zarr.json", json.dumps(document, allow_nan=False).encode()):
        raise ConflictError(f"{root} was written by somebody else meanwhile; give the new build a name of its own")
