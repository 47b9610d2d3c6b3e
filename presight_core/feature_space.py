"""The shared feature space: the PCA and the scale that every tile of every city uses.

A prior is useless to a model trained in another space, so the space is fitted once, frozen and named by
its digest; tiles record the name and readers refuse to mix names.
"""

import hashlib
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from presight_core.recipes import DIGEST_LENGTH


@dataclass(frozen=True)
class FeatureSpace:
    """An affine map from a model's D raw channels to C channels scaled to [0, 1]."""

    mean: NDArray[np.float32]  # (D,)
    components: NDArray[np.float32]  # (C, D) principal directions, largest variance first
    low: NDArray[np.float32]  # (C,) projection that maps to 0
    high: NDArray[np.float32]  # (C,) projection that maps to 1
    explained: NDArray[np.float32]  # (C,) share of the variance of each component
    model_sha256: str  # the feature model whose output this space describes

    @property
    def channel_count(self) -> int:
        """C, the channels of the space."""
        return len(self.components)

    @property
    def space_id(self) -> str:
        """The head of the SHA-256 over every number of the space and its model."""
        digest = hashlib.sha256(self.model_sha256.encode())
        for field in fields(self):
            if field.name != "model_sha256":
                digest.update(np.ascontiguousarray(getattr(self, field.name), np.float32).tobytes())
        return digest.hexdigest()[:DIGEST_LENGTH]

    @property
    def channel_weights(self) -> tuple[float, ...]:
        """How fine the compact cache keeps each channel (C,)."""
        from presight_core.feature_codec import channel_weights  # numba takes a second

        return tuple(channel_weights(self.high - self.low).tolist())

    def picture(self, features: ArrayLike) -> NDArray[np.uint8]:
        """The map from features (..., C) to RGB (..., 3) of every picture: the three directions of largest variance.

        Each has its 1..99 % range spread over 0..255, so that equal features have equal colours everywhere. The last
        channel repeats where C < 3.
        """
        return np.asarray(features, np.uint8)[..., np.minimum([0, 1, 2], self.channel_count - 1)]

    def encode(self, raw: ArrayLike) -> NDArray[np.uint8]:
        """Features (..., C) as uint8, 255 = 1.0, of raw model output (..., D); clipped to the space's range."""
        projected = (np.asarray(raw, np.float32) - self.mean) @ self.components.T
        unit = (projected - self.low) / np.maximum(self.high - self.low, 1e-12)
        return np.round(np.clip(unit, 0, 1) * 255).astype(np.uint8)
