"""The chunks of a tile's arrays: rows to bytes and back, checked on the way, and a bounded cache of decoded ones.

The chunks are those of Zarr v3 (codecs `bytes`, `zstd` or `blosc`, `crc32c`), so that any Zarr library reads them.
They are handled here without one: docs/decisions/008 tells why.
"""

import threading
from collections import OrderedDict
from collections.abc import Hashable
from functools import lru_cache
from typing import Any

import google_crc32c
import numcodecs.blosc
import numpy as np
from numcodecs import Blosc, Zstd
from numpy.typing import NDArray

from presight_core.errors import StoreError
from presight_core.priors.schema import ArraySpec

CHECKSUM_BYTES = 4
ZSTD_LEVEL = 1  # higher levels find nothing more in features, and decode slower
BLOSC_LEVEL = 3  # of zstd, its own default
CURE = "restore the store from a copy, or rebuild the tile and publish again"

numcodecs.blosc.use_threads = False  # its threads do not survive a fork, and data loaders fork


def chunk_path(number: int, spec: ArraySpec) -> str:
    """Where a chunk is, relative to its array."""
    return "/".join(["c", str(number), *("0" for _ in spec.row_shape)])


def array_document(spec: ArraySpec, row_count: int) -> dict[str, Any]:
    """The `zarr.json` of an array of so many rows."""
    return {
        "zarr_format": 3,
        "node_type": "array",
        "shape": [row_count, *spec.row_shape],
        "data_type": spec.dtype,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [spec.chunk_rows, *spec.row_shape]}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": 0,
        "codecs": [_bytes_codec(spec), _compressor_document(spec), {"name": "crc32c"}],
        "attributes": {},
    }


def encode_chunk(rows: NDArray, spec: ArraySpec) -> bytes:
    """The bytes of a chunk that starts with `rows`; those that are missing to a whole chunk are zero."""
    whole = np.zeros((spec.chunk_rows, *spec.row_shape), _stored_dtype(spec))
    whole[: len(rows)] = rows
    compressed = bytes(_compressor(spec).encode(whole))
    return compressed + google_crc32c.value(compressed).to_bytes(CHECKSUM_BYTES, "little")


def chunk_checksum(content: bytes) -> int:
    """The crc32c at the end of a chunk."""
    return int.from_bytes(content[-CHECKSUM_BYTES:], "little")


def decode_chunk(content: bytes | None, spec: ArraySpec, checksum: int, where: str) -> NDArray:
    """The rows of a chunk. Raises StoreError, naming `where`, if it is missing, damaged, or another one."""
    if content is None:
        raise StoreError(f"{where} is missing, which is not an empty road; {CURE}")
    body = content[:-CHECKSUM_BYTES]
    if google_crc32c.value(body) != chunk_checksum(content):
        raise StoreError(f"{where} is damaged, {len(content)} bytes do not match their checksum; {CURE}")
    if chunk_checksum(content) != checksum:
        raise StoreError(f"{where} is damaged, it holds another chunk than the one that was written; {CURE}")
    rows = np.empty((spec.chunk_rows, *spec.row_shape), _stored_dtype(spec))
    _compressor(spec).decode(body, rows)
    return rows


class ChunkCache:
    """Decoded chunks, those used last, up to so many bytes. May be shared by threads."""

    def __init__(self, limit_bytes: int) -> None:
        self._limit_bytes = limit_bytes
        self._chunks: OrderedDict[Hashable, NDArray] = OrderedDict()
        self._lock = threading.Lock()
        self.size_bytes = 0

    def get(self, key: Hashable) -> NDArray | None:
        """A kept chunk."""
        with self._lock:
            if key in self._chunks:
                self._chunks.move_to_end(key)
            return self._chunks.get(key)

    def put(self, key: Hashable, chunk: NDArray) -> None:
        """Keep a chunk, and forget those that were not used for longest."""
        with self._lock:
            if key in self._chunks or chunk.nbytes > self._limit_bytes:
                return
            self._chunks[key] = chunk
            self.size_bytes += chunk.nbytes
            while self.size_bytes > self._limit_bytes:
                self.size_bytes -= self._chunks.popitem(last=False)[1].nbytes

    def clear(self) -> None:
        """Forget everything."""
        with self._lock:
            self._chunks.clear()
            self.size_bytes = 0


def _stored_dtype(spec: ArraySpec) -> np.dtype:
    return np.dtype(spec.dtype).newbyteorder("<")


@lru_cache
def _compressor(spec: ArraySpec) -> Blosc | Zstd:
    """Words are shuffled, so that their high bytes, mostly zero, lie together; single bytes need no Blosc."""
    size = np.dtype(spec.dtype).itemsize
    if size == 1:
        return Zstd(ZSTD_LEVEL)
    return Blosc("zstd", BLOSC_LEVEL, Blosc.SHUFFLE, typesize=size)


def _compressor_document(spec: ArraySpec) -> dict[str, Any]:
    size = np.dtype(spec.dtype).itemsize
    if size == 1:
        return {"name": "zstd", "configuration": {"level": ZSTD_LEVEL, "checksum": False}}
    configuration = {"typesize": size, "cname": "zstd", "clevel": BLOSC_LEVEL, "shuffle": "shuffle", "blocksize": 0}
    return {"name": "blosc", "configuration": configuration}


def _bytes_codec(spec: ArraySpec) -> dict[str, Any]:
    if np.dtype(spec.dtype).itemsize == 1:
        return {"name": "bytes"}  # a single byte has no order
    return {"name": "bytes", "configuration": {"endian": "little"}}
