"""Catalogs for tests: what is recorded in them, their clock, and the databases they are in."""

import sqlite3
from datetime import UTC, datetime, timedelta
from itertools import count
from pathlib import Path

from presight_core.recipes import Recipe
from storage.catalog import Catalog
from storage.database import SqlalchemyDatabase

ENGINES = ("sqlite", "sqlite by sqlalchemy", "postgres")
RECIPE = Recipe("training", 1, {"steps": 10}, {"drives": ["0123456789abcdef"]})
_numbers = count(1)


class Clock:
    """A clock that moves a second at every look."""

    def __init__(self) -> None:
        self.now = datetime(2026, 11, 22, 6, 15, tzinfo=UTC)

    def __call__(self) -> datetime:
        self.now += timedelta(seconds=1)
        return self.now


def sqlite_copy(template: Path, folder: Path) -> Path:
    """A new catalog file, equal to the template: that is faster than to make its schema anew."""
    file = folder / "catalog.sqlite"
    with sqlite3.connect(template) as source, sqlite3.connect(file) as target:
        source.backup(target)
    source.close()
    target.execute("PRAGMA journal_mode = WAL")
    target.close()
    return file


def postgres_template(server: str) -> str:
    """The name of a database with a catalog's schema, made on the server at this URL."""
    Catalog.open(new_postgres(server, "template_of_catalogs"))
    return "template_of_catalogs"


def new_postgres(server: str, name: str | None = None, template: str = "template0") -> str:
    """The URL of a new database on the server at this URL."""
    name = name or f"catalog_{next(_numbers)}"
    database = SqlalchemyDatabase(server)
    with database.engine().connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
        connection.exec_driver_sql(f"CREATE DATABASE {name} TEMPLATE {template}")
    return server.replace("/postgres?", f"/{name}?")
