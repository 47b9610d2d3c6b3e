"""Makes the store that later builds must read as this one does: `python -m tests.stores.make`.

Run it once for each version of the format, when it is released; never change what is in a version's folder.
"""

import hashlib
import json
from pathlib import Path

import numpy as np

from presight_core.priors import PriorReader
from presight_core.priors.documents import GenerationTile
from presight_core.priors.example import ExampleTile
from presight_core.priors.schema import FORMAT_VERSION
from presight_core.priors.window import Window
from storage.priors import PriorStore
from storage.tile_groups import TileName

STORES = Path(__file__).parent
COLUMNS = ("points_world", "features", "hits", "density", "rgb", "observed")
EVERYWHERE = {"x_m": (-30.0, 30.0), "y_m": (-30.0, 30.0), "z_m": (-30.0, 30.0)}


def window_digest(window: Window) -> str:
    """SHA-256 over the columns of a window; positions to a tenth of a millimetre."""
    digest = hashlib.sha256()
    for name in COLUMNS:
        column = getattr(window, name)
        exact = np.round(column * 1e4).astype("<i8") if name == "points_world" else column
        digest.update(np.ascontiguousarray(exact).tobytes())
    return digest.hexdigest()


def main() -> None:
    """Write one small city, two generations and a tag, and what reading it gives."""
    folder = STORES / str(FORMAT_VERSION)
    store, example = PriorStore.open(folder / "store"), ExampleTile(side_blocks=2, voxels_per_block=20)
    store.create_city("town", example.lattice, "space-1", example.channel_count)
    tiling = {"tiling_id": "tiling-1", "city": "town", "tiles": [{"tile_id": "t000", "centroid_m": [0.0, 0.0]}]}
    for seed, parent in enumerate([None, 1]):
        batches = ExampleTile(side_blocks=2, voxels_per_block=20, seed=seed).batches()
        entry = store.write_tile("town", TileName("t000", f"build-{seed}"), batches, ["a", "b", "c"], {})
        store.publish("town", {"t000": GenerationTile(entry, {"stage": "test"})}, parent, tiling)
    store.tag("town", "first", 1)
    expected = {}
    for number in (1, 2):
        reader = PriorReader.open(folder / "store", "town", number)
        digest = reader.generation.tiles["t000"].entry.digest
        expected[number] = {"tile": digest, "window": window_digest(reader.window(np.eye(4), **EVERYWHERE))}
    (folder / "expected.json").write_text(json.dumps(expected, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
