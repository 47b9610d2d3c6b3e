"""Forms in which a city's priors leave the store: memory-mapped blocks, a point cloud, a catalog of places."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.format import open_memmap
from numpy.typing import NDArray

from presight_core.priors.documents import VERSION, lattice_to_json
from presight_core.priors.reader import PriorReader
from presight_core.priors.tile_table import LOOK_ARRAYS

PLY_VERTEX = np.dtype(
    [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("hits", "<u4")]
)
PLY_TYPES = {"<f8": "double", "|u1": "uchar", "<u4": "uint"}
STAC_VERSION = "1.0.0"
EARTH_RADIUS_M = 6_378_137.0  # of the equator, WGS 84; across a city the Earth is a plane
# Latitude and longitude of the origins of nuScenes' maps, as nuScenes publishes them.
MAP_ORIGINS_DEG = {
    "boston-seaport": (42.336849169438615, -71.05785369873047),
    "singapore-onenorth": (1.2882100868743724, 103.78475189208984),
    "singapore-hollandvillage": (1.2993652317780957, 103.78217697143555),
    "singapore-queenstown": (1.2782562240223188, 103.76741409301758),
}


def write_npy(reader: PriorReader, folder: Path) -> None:
    """Write one .npy file a column, blocks of all tiles in Morton order, and `layout.json`, to be memory-mapped."""
    tables = [reader.tile(tile_id) for tile_id in reader.tiles]
    keys = np.concatenate([np.zeros(0, np.uint64), *(table.block_keys for table in tables)])
    counts = np.concatenate([np.zeros(0, np.int64), *(np.diff(table.block_start) for table in tables)])
    order = np.argsort(keys)
    starts = np.append(0, np.cumsum(counts[order]))
    start_of = np.empty(len(keys), np.int64)
    start_of[order] = starts[:-1]
    index = np.concatenate([np.zeros((0, 2), np.int32), *(table.block_index for table in tables)])
    np.save(folder / "block_index.npy", index[order])
    np.save(folder / "block_start.npy", starts)
    size = reader.lattice.block_columns
    observed = np.concatenate([np.zeros((0, size, size // 8), np.uint8), *(table.observed for table in tables)])
    np.save(folder / "observed.npy", observed[order])
    origin_m = np.round(reader.lattice.block_centre(index).mean(0)) if len(index) else np.zeros(2)
    _write_columns(reader, folder, start_of, np.append(origin_m, 0.0))
    layout = {
        "format_version": VERSION,
        "city": reader.generation.city,
        "generation": reader.generation.number,
        "lattice": lattice_to_json(reader.lattice),
        "space_id": reader.space_id,
        "origin_m": [*origin_m.tolist(), 0.0],
        "voxel_count": int(starts[-1]),
    }
    (folder / "layout.json").write_text(json.dumps(layout, indent=1) + "\n", encoding="utf-8")


def _write_columns(reader: PriorReader, folder: Path, start_of: NDArray[np.int64], origin_m: NDArray) -> None:
    """Copy every tile's rows to where its blocks now are: block b of all tiles starts at row start_of[b]."""
    count = sum(tile.entry.voxel_count for tile in reader.generation.tiles.values())
    kinds = {"features": (np.uint8, (reader.channel_count,)), "hits": (np.uint32, ()), "density": (np.float16, ())}
    kinds |= {"rgb": (np.uint8, (3,)), "points": (np.float32, (3,))}
    if not count:  # an empty file cannot be mapped
        for name, (dtype, shape) in kinds.items():
            np.save(folder / f"{name}.npy", np.zeros((0, *shape), dtype))
        return
    files = {
        name: open_memmap(folder / f"{name}.npy", "w+", np.dtype(dtype), (count, *shape))
        for name, (dtype, shape) in kinds.items()
    }
    first_block = 0
    for tile_id in reader.tiles:
        table = reader.tile(tile_id)
        blocks = len(table.block_index)
        shift = start_of[first_block : first_block + blocks] - table.block_start[:-1]
        rows = np.arange(int(table.block_start[-1])) + np.repeat(shift, np.diff(table.block_start))
        for name in LOOK_ARRAYS:
            files[name][rows] = table.all_rows(name)
        files["points"][rows] = table.points() - origin_m
        first_block += blocks
    for file in files.values():
        file.flush()


def write_ply(reader: PriorReader, folder: Path) -> None:
    """Write `<city>.ply`: every voxel's mean surface position, world metres, with its colour and hits."""
    count = sum(tile.entry.voxel_count for tile in reader.generation.tiles.values())
    fields = [f"property {PLY_TYPES[PLY_VERTEX[name].str]} {name}" for name in PLY_VERTEX.names or ()]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *fields, "end_header", ""]
    with (folder / f"{reader.generation.city}.ply").open("wb") as file:
        file.write("\n".join(head).encode())
        for tile_id in reader.tiles:
            table = reader.tile(tile_id)
            vertices = np.zeros(int(table.block_start[-1]), PLY_VERTEX)
            points, rgb = table.points(), table.all_rows("rgb")
            for axis in range(3):
                vertices["xyz"[axis]], vertices[("red", "green", "blue")[axis]] = points[:, axis], rgb[:, axis]
            vertices["hits"] = table.all_rows("hits")
            file.write(vertices.tobytes())


def write_stac(reader: PriorReader, folder: Path, store: str, published: str) -> None:
    """Write a static STAC catalog: one collection for the city, one item a tile, which point into the store.

    store: absolute URL of the store. published: when the generation was, RFC 3339. Tiles of cities whose place on
    Earth is not known have no geometry, only their bounds in world metres.
    """
    city = reader.generation.city
    items = [_item(reader, tile_id, store, published) for tile_id in reader.tiles]
    boxes = [item["bbox"] for item in items if "bbox" in item] or [[-180.0, -90.0, 180.0, 90.0]]
    lows, highs = np.array(boxes)[:, :2].min(0).tolist(), np.array(boxes)[:, 2:].max(0).tolist()
    links = [_link("root", "./catalog.json"), _link("parent", "./catalog.json")]
    collection = {
        "type": "Collection",
        "stac_version": STAC_VERSION,
        "id": city,
        "description": f"Neural priors of {city}, generation {reader.generation.number}.",
        "license": "proprietary",
        "extent": {"spatial": {"bbox": [[*lows, *highs]]}, "temporal": {"interval": [[published, None]]}},
        "links": [*links, *(_link("item", f"./{item['id']}.json") for item in items)],
    }
    catalog = {
        "type": "Catalog",
        "stac_version": STAC_VERSION,
        "id": "presight",
        "description": "Neural priors of cities.",
        "links": [_link("root", "./catalog.json"), _link("child", "./collection.json")],
    }
    documents = {"catalog": catalog, "collection": collection, **{item["id"]: item for item in items}}
    for name, document in documents.items():
        (folder / f"{name}.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def _item(reader: PriorReader, tile_id: str, store: str, published: str) -> dict[str, Any]:
    entry, city = reader.generation.tiles[tile_id].entry, reader.generation.city
    block_m, origin_m = reader.lattice.block_m, reader.lattice.origin_m
    left, bottom, right, top = entry.block_bounds
    bounds_m = [left * block_m + origin_m[0], bottom * block_m + origin_m[1]]
    bounds_m += [(right + 1) * block_m + origin_m[0], (top + 1) * block_m + origin_m[1]]
    links = [_link("root", "./catalog.json"), _link("parent", "./collection.json")]
    return {
        "type": "Feature",
        "stac_version": STAC_VERSION,
        "id": f"{city}-{tile_id}",
        "collection": city,
        **_place(city, bounds_m),
        "properties": {
            "datetime": published,
            "presight:bounds_m": bounds_m,
            "presight:generation": reader.generation.number,
            "presight:voxel_count": entry.voxel_count,
            "presight:digest": entry.digest,
            "presight:space_id": entry.space_id,
        },
        "links": [*links, _link("collection", "./collection.json")],
        "assets": {
            "voxels": {
                "href": f"{store.rstrip('/')}/{city}/{entry.path}",
                "type": "application/vnd+zarr",
                "roles": ["data"],
            }
        },
    }


def _place(city: str, bounds_m: list[float]) -> Mapping[str, Any]:
    """Geometry and bounding box, degrees of longitude and latitude."""
    if city not in MAP_ORIGINS_DEG:
        return {"geometry": None}
    latitude, longitude = MAP_ORIGINS_DEG[city]
    degree_m = np.deg2rad(1.0) * EARTH_RADIUS_M
    scale = degree_m * np.array([np.cos(np.deg2rad(latitude)), 1.0])
    west, south, east, north = (np.reshape(bounds_m, (2, 2)) / scale + [longitude, latitude]).ravel().tolist()
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    return {"geometry": {"type": "Polygon", "coordinates": [ring]}, "bbox": [west, south, east, north]}


def _link(relation: str, href: str) -> dict[str, str]:
    kind = "application/geo+json" if relation == "item" else "application/json"
    return {"rel": relation, "href": href, "type": kind}
