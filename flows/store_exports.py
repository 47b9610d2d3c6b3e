"""`presight export` and `presight import`: a city's priors to and from the forms of other programs."""

import hashlib
from datetime import UTC
from pathlib import Path

from flows.store_commands import Layout
from presight_core.errors import ConflictError, InputError
from presight_core.grid import Lattice
from presight_core.priors.documents import GenerationTile, generation_path
from presight_core.priors.exports import write_npy, write_ply, write_stac
from presight_core.priors.legacy import legacy_batches, read_legacy, write_legacy
from presight_core.priors.location import local_folder
from presight_core.priors.reader import PriorReader
from storage.folders import whole_folder
from storage.location import objects, open_store
from storage.priors import PriorStore
from storage.tile_groups import TileName
from storage.workspace import Workspace

EXPORT_CACHE_BYTES = 0  # whole arrays pass once; keeping chunks would only cost memory


def export_city(folder: Path, city: str, generation: str | None, layout: Layout, out: Path) -> None:
    """Write a city's priors into <out>/<city>, whole or not at all. Raises ConflictError if that is there."""
    location = Workspace.open(folder).store_location
    number = int(generation) if generation and generation.isdigit() else generation
    reader = PriorReader.open(location, city, number, EXPORT_CACHE_BYTES)
    target = out / city
    if target.exists():
        raise ConflictError(f"{target} is there; move it away, or choose another --out")
    with whole_folder(target) as temporary:
        if layout is Layout.LEGACY:
            write_legacy(reader, temporary)
        elif layout is Layout.NPY:
            write_npy(reader, temporary)
        elif layout is Layout.PLY:
            write_ply(reader, temporary)
        else:
            write_stac(reader, temporary, _url(location), _published(location, reader))
    print(f"{city} generation {reader.generation.number}: {target}")


def import_city(folder: Path, city: str, files: list[Path], space: str) -> None:
    """Read released pickles, one a tile, into a new city of the store, and publish it."""
    store, lattice = PriorStore.open(Workspace.open(folder).store_location), Lattice()
    missing = [str(file) for file in files if not file.is_file()]
    if missing:
        raise InputError(f"{', '.join(missing)}: not there; pass the released <city>-c<i>.pkl files")
    legacy = [read_legacy(file) for file in files]
    widths = {tile.features.shape[1] for tile in legacy}
    if len(widths) > 1 or any(not len(tile.hits) for tile in legacy):
        raise InputError(f"{city}: pickles of {sorted(widths)} channels or without voxels; pass those of one city")
    facts = store.create_city(city, lattice, space, widths.pop())
    tiles, registry = {}, []
    for number, (file, batches) in enumerate(zip(files, legacy_batches(legacy, lattice), strict=True)):
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
        tile_id, recipe = (
            f"t{number:03d}",
            {"stage": "import", "version": 1, "settings": {}, "inputs": {file.name: digest}},
        )
        name = TileName(tile_id, f"import-{digest[:16]}")
        entry = store.write_tile(facts.city, name, batches, [f"pickle-{digest[:16]}"], {"recipe": recipe})
        tiles[tile_id] = GenerationTile(entry, recipe)
        centroid_m = legacy[number].points_world[:, :2].mean(0).tolist()
        registry.append({"tile_id": tile_id, "centroid_m": centroid_m})
        print(f"{file.name}: {entry.voxel_count:,} voxels")
    generation = store.publish(city, tiles, None, {"tiling_id": f"import-{space}", "city": city, "tiles": registry})
    print(f"{city}: generation {generation}")


def _url(location: str) -> str:
    folder = local_folder(location)
    return location if folder is None else folder.resolve().as_uri()


def _published(location: str, reader: PriorReader) -> str:
    """When the reader's generation was published."""
    path = generation_path(reader.generation.city, reader.generation.number)
    (found,) = [entry for entry in objects(open_store(location), path.rpartition("/")[0]) if entry.path == path]
    return found.modified.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
