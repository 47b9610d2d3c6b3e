"""Bytes a voxel against the error of its features, for coarser steps and for a product-quantised codebook.

Run with `python -m bench.prior_size STORE CITY...`, on cities made with `create_city(..., feature_step=1)`: they hold
features as extraction gives them. The error is the root mean square of what is lost, as a share of that of the
features around their mean, which is what tells one place from another.
"""

import sys

import numpy as np
from numpy.typing import NDArray
from sklearn.cluster import MiniBatchKMeans

from presight_core.priors import PriorReader
from presight_core.priors.chunks import encode_chunk
from presight_core.priors.schema import ArraySpec, array_specs, pack_features, unpack_features

STEPS = (1, 3, 5)
PARTS = 16  # bytes of codes a voxel: each stands for 4 of 64 channels
CODES = 256  # that one byte can name
SAMPLE = 40_000  # voxels that the codebook is fitted to
NARROW = ("voxel", "centroid", "hits", "density", "rgb", "drives")


def main(location: str, cities: list[str]) -> None:
    """Print a table of each city."""
    for city in cities:
        reader = PriorReader.open(location, city)
        tables = [reader.tile(tile_id) for tile_id in reader.tiles]
        features = np.concatenate([table.all_rows("features") for table in tables])
        specs = array_specs(reader.channel_count, max(len(table.drives) for table in tables), 32)
        narrow = {name: bytes_a_row(np.concatenate([t.all_rows(name) for t in tables]), specs[name]) for name in NARROW}
        others = sum(narrow.values())
        print(f"{city}, {len(features):,} voxels; " + ", ".join(f"{name} {size:.2f}" for name, size in narrow.items()))
        for step in STEPS:
            codes = pack_features(features, step)
            size = bytes_a_row(codes, specs["features"])
            # What uint8 itself rounds away is even over one of its steps; the rest comes on top.
            lost = np.sqrt(1 / 12 + mean_square(unpack_features(codes, step), features))
            sizes = f"features {size:.1f}, voxel {size + others:.1f}"
            print(f"  steps of {step}/255: {sizes}, error {lost / spread(features):.2%}")
        codes, decoded = product_quantised(features)
        size = bytes_a_row(codes, ArraySpec("uint8", (PARTS,), "voxel"))
        error = np.sqrt(1 / 12 + mean_square(decoded, features)) / spread(features)
        print(f"  {PARTS} codes of {CODES}: features {size:.1f}, voxel {size + others:.1f}, error {error:.2%}")


def product_quantised(features: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Codes (N, PARTS) of a codebook fitted to the city, and the features that they stand for."""
    sample = np.random.default_rng(0).permutation(len(features))[:SAMPLE]
    codes, decoded = [], []
    for part in np.split(features.astype(np.float32), PARTS, axis=1):
        means = MiniBatchKMeans(CODES, batch_size=4096, n_init=1, random_state=0).fit(part[sample])
        codes.append(means.predict(part).astype(np.uint8))
        decoded.append(means.cluster_centers_[codes[-1]])
    return np.stack(codes, axis=1), np.concatenate(decoded, axis=1)


def bytes_a_row(rows: NDArray, spec: ArraySpec) -> float:
    """Stored bytes a row of whole chunks."""
    whole = len(rows) // spec.chunk_rows * spec.chunk_rows
    chunks = (rows[first : first + spec.chunk_rows] for first in range(0, whole, spec.chunk_rows))
    return sum(len(encode_chunk(chunk, spec)) for chunk in chunks) / whole


def mean_square(decoded: NDArray, features: NDArray[np.uint8]) -> float:
    """Mean square of the difference, in 1/255."""
    return float(np.mean((decoded.astype(np.float32) - features) ** 2))


def spread(features: NDArray[np.uint8]) -> float:
    """Root mean square of the features around each channel's mean, in 1/255."""
    return float(np.sqrt(features.var(axis=0, dtype=np.float64).mean()))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
