"""One run builds a city at a time, and what a run that died left behind is found and ended.

The rules are in docs/decisions/009-leases-and-fencing.md.
"""

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path

from flows.background import beside
from flows.console import print_json
from flows.jobs import recipe_from
from presight_core.errors import ConflictError, PresightError, StoreError
from presight_core.failpoints import failpoint
from presight_core.priors.documents import Generation
from storage.catalog import Build, Catalog
from storage.leases import Lease, LeaseHeldError, LeaseLostError, this_process
from storage.restoration import follow, restore
from storage.workspace import Workspace

POLL_S = 1.0  # how often a waiting run looks whether the city is free
RUN_ENDED = "its run ended without a word"
BEATS = 4  # renewals in the life of a lease: three may fail or come late


@contextmanager
def hold_city(workspace: Workspace, city: str, wait: bool = False) -> Iterator[Lease]:
    """The only right to build and publish in the city, for as long as the block runs.

    What earlier runs left unfinished is ended first. Raises LeaseHeldError while another run is at work, unless
    `wait`.
    """
    catalog, seconds = workspace.catalog(), workspace.settings.lease_s
    lease = _take(workspace, catalog, city, wait)
    with _heartbeat(catalog, lease, seconds):
        # Before anything is planned: from here on the city changes by our hand only. If this fails the lease
        # stays as it is, and whoever takes it next does the same.
        failpoint("lease-taken")
        if lease.follows_lost:
            workspace.store().raise_fence(city, lease.token)
        end_orphans(workspace, city)
        follow(catalog, workspace.store(), city, lease)
        try:
            yield lease
        except StoreError:
            raise  # a put without an answer may land later: the lease stays lost, so that the next run fences it out
        except BaseException as error:
            with suppress(PresightError):  # the first error counts; reconcile does the rest
                _end(workspace, lease, f"{type(error).__name__}: {error}")
            raise
        _end(workspace, lease, RUN_ENDED)


def _end(workspace: Workspace, lease: Lease, reason: str) -> None:
    with suppress(LeaseLostError):  # then the next run does it
        follow(workspace.catalog(), workspace.store(), lease.city, lease)
    workspace.catalog().leases.end(lease)
    failpoint("lease-ended")
    end_orphans(workspace, lease.city, reason)


def end_orphans(workspace: Workspace, city: str, reason: str = RUN_ENDED) -> list[Build]:
    """End the builds of the city that nobody works on: as published if the prior shows them, as failed if not."""
    catalog, store = workspace.catalog(), workspace.store()
    orphans = catalog.orphans(city)
    head = store.generation(city) if orphans else None
    for build in orphans:
        if _is_shown(head, build):
            assert head is not None
            lineage = head.tiles[build.tile_id].lineage
            metrics = {**lineage.get("metrics", {}), "generation": store.first_showing(head, build.tile_id)}
            finished_at = lineage.get("build", {}).get("finished_at")
            catalog.finish_build(build.build_id, "published", metrics, finished_at=finished_at)
        else:
            error = f"{reason}; last heard of at {build.updated_at}; run it again, `presight build {city}` or `update`"
            with suppress(ConflictError):  # two may find it at once
                catalog.finish_build(build.build_id, "failed", None, error)
    return orphans


def reconcile(workspace: Workspace, city: str | None = None) -> list[Build]:
    """Find runs that died, of a city or of all; end their leases and builds. The builds, as they are now."""
    catalog = workspace.catalog()
    cities = {lease.city for lease in catalog.leases.lost()} | {build.city for build in catalog.orphans()}
    ended: list[Build] = []
    for name in sorted(cities if city is None else cities & {city}):
        before = {build.build_id for build in catalog.running(name)}
        try:
            with hold_city(workspace, name):
                pass
        except LeaseHeldError:
            continue  # somebody was faster, and ends what there is to end
        ended += [build for build in catalog.builds(name) if build.build_id in before]
    return ended


def show_reconciled(folder: Path, city: str | None, as_json: bool) -> None:
    """Reconcile and say what was found."""
    ended = reconcile(Workspace.open(folder).require(), city)
    if as_json:
        print_json([{"city": b.city, "tile_id": b.tile_id, "state": b.state, "error": b.error} for b in ended])
        return
    for build in ended:
        print(f"{build.city}  {build.tile_id}  {build.state}  {build.error}".rstrip())
    print(f"{len(ended)} builds of dead runs ended" if ended else "nothing to reconcile")


def rebuild(folder: Path, as_json: bool) -> None:
    """Make the catalog of a workspace again. Raises ConflictError if it is not empty."""
    workspace = Workspace.open(folder)
    counts = restore(workspace.catalog(), workspace.drives(), workspace.store())
    if as_json:
        print_json(counts)
        return
    print(", ".join(f"{count} {name}" for name, count in counts.items()) + f" in {workspace.catalog_url}")


def _take(workspace: Workspace, catalog: Catalog, city: str, wait: bool) -> Lease:
    """The lease, as soon as it may be had."""
    told = False
    while True:
        try:
            # A catalog that was made anew counts from 1 again; the store knows how far the numbers are.
            above = workspace.store().fence(city)
            return catalog.leases.take(city, this_process(), workspace.settings.lease_s, above)
        except LeaseHeldError as error:
            if not wait:
                raise
            if not told:
                print(f"{error}; waiting", file=sys.stderr)
            told = True
            time.sleep(POLL_S)


def _heartbeat(catalog: Catalog, lease: Lease, seconds: float) -> AbstractContextManager[None]:
    """Renew the lease in the background until the block ends."""

    def beat(stop: threading.Event) -> None:
        while not stop.wait(seconds / BEATS):
            try:
                catalog.leases.renew(lease, seconds)
            except LeaseLostError:
                return  # nothing more can be published; the builds find out by themselves
            except StoreError:
                continue  # the catalog may be back before the lease is over

    return beside(beat, f"heartbeat of {lease.city}")


def _is_shown(head: Generation | None, build: Build) -> bool:
    """Whether the prior shows the build's recipe: only stale tiles are built, so that it is this build."""
    tile = head.tiles.get(build.tile_id) if head else None
    return tile is not None and recipe_from(tile.recipe).digest == build.recipe_digest
