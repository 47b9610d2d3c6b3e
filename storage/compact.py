"""The compact code of feature maps as a Zarr codec, so that an array of features reads alike in both tiers."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from zarr.abc.codec import ArrayBytesCodec
from zarr.core.array_spec import ArraySpec
from zarr.core.buffer import Buffer, NDBuffer
from zarr.registry import register_codec

NAME = "presight.compact_features"


@dataclass(frozen=True)
class CompactFeatures(ArrayBytesCodec):
    """Lossy: a chunk (1, rows, columns, C) of uint8 features becomes at most 60 kB at the paper's grid."""

    weights: tuple[float, ...]  # how fine each channel is kept; see `feature_codec.channel_weights`

    is_fixed_size = False

    def __init__(self, *, weights: Sequence[float]) -> None:
        object.__setattr__(self, "weights", tuple(float(weight) for weight in weights))

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """The codec that an array's metadata names."""
        return cls(weights=data["configuration"]["weights"])

    def to_dict(self) -> dict[str, Any]:
        """The codec's name and weights, for an array's metadata."""
        return {"name": NAME, "configuration": {"weights": list(self.weights)}}

    def compute_encoded_size(self, input_byte_length: int, chunk_spec: ArraySpec) -> int:
        """Not known before the chunk is encoded."""
        raise NotImplementedError

    async def _encode_single(self, chunk_data: NDBuffer, chunk_spec: ArraySpec) -> Buffer:
        from presight_core import feature_codec  # numba takes a second, which `presight status` has not

        features = np.asarray(chunk_data.as_numpy_array(), np.uint8)[0]
        return chunk_spec.prototype.buffer.from_bytes(feature_codec.encode(features, self.weights))

    async def _decode_single(self, chunk_data: Buffer, chunk_spec: ArraySpec) -> NDBuffer:
        from presight_core import feature_codec

        features = feature_codec.decode(chunk_data.to_bytes())[None]
        if features.shape != tuple(chunk_spec.shape):
            raise ValueError(f"features of shape {features.shape} in an array of chunks {chunk_spec.shape}")
        return chunk_spec.prototype.nd_buffer.from_numpy_array(features)


register_codec(NAME, CompactFeatures)
