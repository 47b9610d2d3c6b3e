"""At most one run builds a city, and fencing numbers only grow: on every database that a catalog may have."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta

import pytest

from presight_core.errors import ConflictError
from presight_core.progress import Progress
from storage.catalog import Catalog
from storage.leases import LeaseHeldError, LeaseLostError, is_gone, this_process
from tests.storage.catalogs import RECIPE, Clock

FAR = "elsewhere:1:1:another machine"  # an owner of whom this machine can tell nothing


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def leases(url, clock):
    return Catalog.open(url, clock).leases


def test_a_city_has_one_holder(leases):
    lease = leases.take("toytown", FAR)
    with pytest.raises(LeaseHeldError, match="process 1 of elsewhere"):
        leases.take("toytown", "other:2:2:here")
    assert leases.current("toytown") == lease
    assert leases.take("othertown", FAR).token == 1


def test_a_lease_that_was_given_back_can_be_had_at_once(leases):
    leases.end(leases.take("toytown", FAR))
    second = leases.take("toytown", "other:2:2:here")
    assert (second.token, second.follows_lost) == (2, False)


def test_a_silent_holder_loses_the_lease_to_a_greater_number(leases, clock):
    first = leases.take("toytown", FAR, seconds=30)
    clock.now += timedelta(seconds=60)
    assert leases.current("toytown") is None
    assert [lease.token for lease in leases.lost()] == [1]
    second = leases.take("toytown", "other:2:2:here")
    assert (second.token, second.follows_lost) == (2, True)
    for act in (leases.renew, leases.require):
        with pytest.raises(LeaseLostError, match="silent for too long"):
            act(first)


def test_what_the_old_holder_ends_is_not_the_new_holders_lease(leases, clock):
    first = leases.take("toytown", FAR, seconds=1)
    clock.now += timedelta(seconds=60)
    second = leases.take("toytown", "other:2:2:here")
    leases.end(first)
    leases.require(second)


def test_a_heartbeat_keeps_the_lease(leases, clock):
    lease = leases.take("toytown", FAR, seconds=30)
    for _ in range(5):
        clock.now += timedelta(seconds=20)
        leases.renew(lease, seconds=30)
    leases.require(lease)
    with pytest.raises(LeaseHeldError):
        leases.require_free("toytown")


def test_a_late_heartbeat_counts_if_nobody_took_the_lease(leases, clock):
    lease = leases.take("toytown", FAR, seconds=30)
    clock.now += timedelta(seconds=3600)
    leases.renew(lease, seconds=30)
    assert leases.current("toytown").token == lease.token


def test_fencing_numbers_go_on_from_what_the_store_has_seen(leases):
    assert leases.take("toytown", FAR, above=41).token == 42


def test_of_many_that_want_a_city_at_once_one_gets_it(leases):
    def take(number: int) -> bool:
        try:
            return bool(leases.take("toytown", f"elsewhere:{number}:1:x"))
        except LeaseHeldError:
            return False

    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(take, range(16))).count(True) == 1


def test_a_dead_process_of_this_machine_need_not_be_waited_for(leases):
    code = "from storage.leases import this_process; print(this_process())"
    owner = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()
    assert is_gone(owner)
    leases.take("toytown", owner)
    assert leases.take("toytown", this_process()).follows_lost


def test_a_living_process_or_one_of_another_machine_is_never_taken_for_dead():
    host, process, started, space = this_process().split(":")
    assert not is_gone(this_process())
    assert is_gone(f"{host}:{process}:{int(started) - 1}:{space}"), "an earlier process of the same number"
    assert not is_gone(FAR)
    assert not is_gone("a name of any kind")


def test_builds_are_orphans_as_soon_as_their_lease_is_over(url, clock):
    catalog = Catalog.open(url, clock)
    lease = catalog.leases.take("toytown", FAR)
    build_id = catalog.start_build("toytown", "t000", RECIPE, lease)
    assert catalog.orphans() == []
    catalog.leases.end(lease)
    assert [build.build_id for build in catalog.orphans("toytown")] == [build_id]
    assert catalog.orphans("othertown") == []
    catalog.leases.take("toytown", FAR)
    assert [build.lease_token for build in catalog.orphans()] == [lease.token]


def test_a_run_that_lost_its_lease_starts_no_build(url, clock):
    catalog = Catalog.open(url, clock)
    lease = catalog.leases.take("toytown", FAR)
    catalog.leases.end(lease)
    with pytest.raises(LeaseLostError):
        catalog.start_build("toytown", "t000", RECIPE, lease)
    assert catalog.builds("toytown") == []


def test_a_build_that_was_ended_hears_of_it_and_cannot_come_back(url):
    catalog = Catalog.open(url)
    build_id = catalog.start_build("toytown", "t000", RECIPE)
    assert catalog.progress(build_id, Progress("training", 1, 10))
    catalog.finish_build(build_id, "failed", None, "taken for dead")
    assert not catalog.progress(build_id, Progress("training", 2, 10))
    with pytest.raises(ConflictError, match="ended before"):
        catalog.finish_build(build_id, "published")
    assert catalog.builds("toytown")[0].error == "taken for dead"
