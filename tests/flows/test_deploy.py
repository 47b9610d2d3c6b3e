"""What `presight deploy` refuses, and how it says so."""

import json

import pytest

from tests.torture.toy_city import CITY, VERSION

NOBODY = "http://127.0.0.1:9/api"  # the discard port: nothing listens there


@pytest.fixture
def refused(city, presight):
    """Runs the command, which must refuse as bad input; what it says."""

    def run(*arguments: str) -> str:
        result = presight(city.root, *arguments)
        assert result.returncode == 2, result.stderr
        assert "Traceback" not in result.stderr
        return result.stderr

    return run


def test_without_a_server_it_says_how_to_start_one(refused):
    for command in (("deploy", CITY), ("deploy", CITY, "--remove"), ("serve-flows",)):
        assert "prefect server start" in refused(*command)


def test_a_bad_schedule_is_named(refused, monkeypatch):
    monkeypatch.setenv("PREFECT_API_URL", NOBODY)
    assert "'every day' is no schedule" in refused("deploy", CITY, "--cron", "every day")
    assert "there are rebuild" in refused("deploy", CITY, "--cron", "sweep=0 2 * * 6")
    assert "no such zone" in refused("deploy", CITY, "--cron", "0 2 * * 6", "--timezone", "Mars/Gale")


def test_a_city_without_drives_is_named(refused, monkeypatch):
    monkeypatch.setenv("PREFECT_API_URL", NOBODY)
    assert "atlantis: no drive of this city" in refused("deploy", "atlantis")


def test_a_server_that_does_not_answer_is_named(refused, monkeypatch):
    monkeypatch.setenv("PREFECT_API_URL", NOBODY)
    assert f"{NOBODY}: no Prefect server answers there" in refused("deploy", CITY)


def test_drives_are_ingested_also_if_the_server_does_not_answer(new_city, presight, monkeypatch):
    monkeypatch.setenv("PREFECT_API_URL", NOBODY)
    assert presight(new_city.root, "drives", "remove", "scene-0000").returncode == 0
    result = presight(new_city.root, "ingest", new_city.data, "--version", VERSION, "--json")
    assert result.returncode == 0
    assert [drive["new"] for drive in json.loads(result.stdout)["drives"]] == [True, False]
    assert "no update was started" in result.stderr
