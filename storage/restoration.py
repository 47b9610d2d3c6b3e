"""A lost catalog is made again: drives from their index, tilings and published builds from the store.

What is needed for that is written down beside the priors when they are made. Builds that never were published, and
rejects of later stages, are not in the store; they are history, not truth.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any

from presight_core.errors import ConflictError
from presight_core.priors.documents import GenerationTile
from presight_core.recipes import Recipe
from presight_core.tiles import Tiling
from storage.catalog import Build, Catalog
from storage.drives import DriveIndex
from storage.leases import Lease
from storage.priors import PriorStore

KIND = "tilings"
REMEMBERED = ("stage", "done", "total", "figures", "started_at", "lease_token")  # of a build's row


def remember_tiling(store: PriorStore, catalog: Catalog, tiling: Tiling) -> None:
    """Write down the city's tiling, as the catalog has it, beside the priors."""
    document = {
        "tiling": tiling.to_json(),
        "settings": catalog.tiling_settings(tiling.city),
        "created_at": catalog.tiling_created_at(tiling.city),
    }
    with suppress(ConflictError):  # a catalog that was made anew and not restored: the first word counts
        store.save_document(tiling.city, KIND, f"{tiling.tiling_id}-{len(tiling.tiles)}", document)


def remember_build(tile: GenerationTile, build: Build | None, finished_at: str) -> GenerationTile:
    """The tile, with what the catalog knows of its build."""
    known = {name: getattr(build, name) for name in REMEMBERED} if build else {}
    return replace(tile, lineage={**tile.lineage, "build": {**known, "finished_at": finished_at}})


def restore(catalog: Catalog, index: DriveIndex, store: PriorStore) -> dict[str, int]:
    """Fill an empty catalog; how many drives, tilings and builds it has now.

    Raises ConflictError if the catalog has a drive.
    """
    if catalog.cities():
        raise ConflictError("the catalog has drives; move it away first, or name another one in presight.toml")
    drives = sorted(index.drives(), key=lambda drive: (index.added_at(drive.drive_id), drive.drive_id))
    for drive in drives:  # in the order of before: a corrected drive removes its faulty self again
        catalog.add_drive(drive, index.rejects(drive.drive_id), index.added_at(drive.drive_id) or None)
    for drive in drives:
        removed_at = index.removed_at(drive.drive_id)
        if removed_at:
            catalog.remove_drive(drive.drive_id, removed_at)
    counts = {"drives": len(drives), "tilings": 0, "builds": 0}
    for city in sorted({drive.city for drive in drives}):
        counts["tilings"] += _restore_tilings(catalog, store, city)
        head = store.generation(city)
        for build in _published(store, city, catalog.now()):
            is_shown = head is not None and build.tile_id in head.tiles
            catalog.restore_build(build if is_shown else replace(build, state="withdrawn"))
            counts["builds"] += 1
        follow(catalog, store, city)
    return counts


def follow(catalog: Catalog, store: PriorStore, city: str, lease: Lease | None = None) -> None:
    """Let the catalog tell of every tile what the newest generation shows; it wants this after a rollback or a crash.

    Raises LeaseLostError if `lease` is over: then it is somebody else's to tell.
    """
    head, told = store.generation(city), {build.tile_id: build for build in catalog.builds(city, "published")}
    shown = head.tiles if head else {}
    for tile_id in sorted(told.keys() - shown.keys()):
        catalog.withdraw_tile(city, tile_id, lease)
    for tile_id, tile in shown.items():
        started_at = tile.lineage.get("build", {}).get("started_at")
        if started_at and (tile_id not in told or told[tile_id].started_at != started_at):
            assert head is not None
            build = _row(city, tile_id, tile, store.first_showing(head, tile_id), catalog.now())
            catalog.show_again(build, lease)


def _restore_tilings(catalog: Catalog, store: PriorStore, city: str) -> int:
    documents = [store.document(city, KIND, name) for name in store.documents(city, KIND)]
    for document in sorted(documents, key=lambda each: (each["created_at"], len(each["tiling"]["tiles"]))):
        catalog.save_tiling(Tiling.from_json(document["tiling"]), document["settings"], document["created_at"])
    head = store.generation(city)
    if not documents and head and head.tiling["tiles"]:  # a store of before tilings were written down
        catalog.save_tiling(Tiling.from_json(head.tiling), {})
        return 1
    return len({document["tiling"]["tiling_id"] for document in documents})


def _published(store: PriorStore, city: str, now: str) -> Iterator[Build]:
    """Every build that a generation ever brought, in the order of the generations."""
    brought: set[str] = set()
    for number in store.generations(city):
        generation = store.generation(city, number)
        for tile_id, tile in generation.tiles.items() if generation else ():
            if tile.entry.path not in brought:
                brought.add(tile.entry.path)
                yield _row(city, tile_id, tile, number, now)


def _row(city: str, tile_id: str, tile: GenerationTile, number: int, now: str) -> Build:
    known: dict[str, Any] = {"stage": "", "done": 0, "total": 0, "figures": {}, "started_at": now, "finished_at": now}
    known |= tile.lineage.get("build", {})
    return Build(
        build_id=0,  # the catalog gives a number
        city=city,
        tile_id=tile_id,
        recipe=tile.recipe,
        recipe_digest=Recipe(**tile.recipe).digest,
        state="published",
        metrics={**tile.lineage.get("metrics", {}), "generation": number},
        error="",
        updated_at=known["finished_at"],
        **known,
    )
