"""SQL on the catalog's database: by the standard library for SQLite, by SQLAlchemy for everything else.

Importing SQLAlchemy takes longer than all of `presight status` may. So the embedded default does without it, but for
making or migrating the schema; both ways run the same SQL, with `:named` values.
"""

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from presight_core.errors import ConflictError, MissingDependencyError, StoreError
from presight_core.failpoints import failpoint

if TYPE_CHECKING:
    from sqlalchemy import Connection, Engine

SQLITE = "sqlite:///"
BUSY_S = 30.0  # how long a writer waits for the others; each holds the lock for milliseconds
PRAGMAS = (
    f"PRAGMA busy_timeout = {BUSY_S * 1000:.0f}",
    "PRAGMA synchronous = FULL",  # with WAL: nothing acknowledged is lost, also when power fails
    "PRAGMA foreign_keys = ON",
)
VERSION_TABLE = "alembic_version"
WRITE_LOCK = 0x50524553  # "PRES": a number for PostgreSQL's advisory lock that nobody else takes


class Query(Protocol):
    """Runs one statement inside a transaction."""

    def __call__(self, sql: str, **values: Any) -> list[dict[str, Any]]:
        """The rows that the statement returns, if any, by column name."""
        ...

    def tuples(self, sql: str, **values: Any) -> Sequence[Sequence[Any]]:
        """The same rows as the statement orders their columns: for thousands of them."""
        ...


class Database(Protocol):
    """A database that may be used from many threads and processes, also after a fork: no connection is kept."""

    def reading(self) -> AbstractContextManager[Query]:
        """A transaction that reads."""
        ...

    def writing(self) -> AbstractContextManager[Query]:
        """A transaction that writes; commits at its end, rolls back on an exception."""
        ...

    def revision(self) -> str | None:
        """The schema's revision; None for an empty database."""
        ...

    def engine(self) -> "Engine":
        """A SQLAlchemy engine on it, for migrations."""
        ...


def open_database(url: str) -> Database:
    """The database at a SQLAlchemy URL. Raises StoreError, or MissingDependencyError for an absent driver."""
    if not url.startswith(SQLITE):
        return SqlalchemyDatabase(url)
    file = url.removeprefix(SQLITE)
    if file in ("", ":memory:"):
        raise StoreError(f"{url}: a catalog in memory is gone when the command ends; name a file")
    return SqliteDatabase(Path(file))


class SqliteDatabase:
    """An SQLite file."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def reading(self) -> AbstractContextManager[Query]:
        """A transaction that reads one state of the database."""
        return self._transaction("BEGIN")

    def writing(self) -> AbstractContextManager[Query]:
        """A transaction that writes; it takes the lock at once, as a later upgrade could not wait for it."""
        return self._transaction("BEGIN IMMEDIATE")

    def revision(self) -> str | None:
        """The schema's revision; None for an absent or empty file."""
        if not self.file.exists():
            return None
        with self.reading() as query:
            if not query("SELECT 1 FROM sqlite_master WHERE name = :name", name=VERSION_TABLE):
                return None
            return _revision(query)

    def engine(self) -> "Engine":
        """A SQLAlchemy engine whose transactions take the write lock; makes the file's folder."""
        from sqlalchemy import URL

        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise _unusable(str(self.file), error) from error
        with _sqlite_errors(self.file), _connected(self.file) as connection:
            connection.execute("PRAGMA journal_mode = WAL")  # kept in the file; readers never wait for writers
        return _engine(URL.create("sqlite", database=str(self.file)))

    @contextmanager
    def _transaction(self, begin: str) -> Iterator[Query]:
        with _sqlite_errors(self.file), _connected(self.file) as connection:
            connection.execute(begin)
            yield _SqliteQuery(connection)
            failpoint("catalog-before-commit")
            connection.execute("COMMIT")  # an exception closes the connection instead: SQLite rolls back
        failpoint("catalog-after-commit")


@contextmanager
def _connected(file: Path) -> Iterator[sqlite3.Connection]:
    connection = sqlite3.connect(file, timeout=BUSY_S, isolation_level=None)
    try:
        for pragma in PRAGMAS:
            connection.execute(pragma)
        yield connection
    finally:
        connection.close()


@contextmanager
def _sqlite_errors(file: Path) -> Iterator[None]:
    try:
        yield
    except sqlite3.IntegrityError as error:
        raise _conflict(str(file), error) from error
    except sqlite3.Error as error:
        raise _unusable(str(file), error) from error


class _SqliteQuery:
    def __init__(self, connection: sqlite3.Connection) -> None:
        self.connection = connection

    def __call__(self, sql: str, **values: Any) -> list[dict[str, Any]]:
        cursor = self.connection.execute(sql, values)
        names = [column[0] for column in cursor.description or ()]
        return [dict(zip(names, row, strict=True)) for row in cursor]

    def tuples(self, sql: str, **values: Any) -> Sequence[Sequence[Any]]:
        return self.connection.execute(sql, values).fetchall()


class SqlalchemyDatabase:
    """Any database that SQLAlchemy reaches."""

    def __init__(self, url: str) -> None:
        self._engine = _engine(url)
        self._name = self._engine.url.render_as_string(hide_password=True)

    def reading(self) -> AbstractContextManager[Query]:
        """A transaction that reads."""
        return self._transaction()

    def writing(self) -> AbstractContextManager[Query]:
        """A transaction that writes; one at a time, as in SQLite."""
        return self._transaction(lock=True)

    def revision(self) -> str | None:
        """The schema's revision; None for an empty database."""
        import sqlalchemy

        with self._connected() as connection:
            if not sqlalchemy.inspect(connection).has_table(VERSION_TABLE):
                return None
            return _revision(_SqlalchemyQuery(connection))

    def engine(self) -> "Engine":
        """The engine."""
        return self._engine

    @contextmanager
    def _transaction(self, lock: bool = False) -> Iterator[Query]:
        with self._connected() as connection:
            if lock:
                take_write_lock(connection)
            yield _SqlalchemyQuery(connection)
            failpoint("catalog-before-commit")
        failpoint("catalog-after-commit")

    @contextmanager
    def _connected(self) -> "Iterator[Connection]":
        from sqlalchemy import exc

        try:
            with self._engine.begin() as connection:
                yield connection
        except exc.IntegrityError as error:
            raise _conflict(self._name, error.orig) from error
        except exc.SQLAlchemyError as error:
            raise _unusable(self._name, getattr(error, "orig", None) or error) from error


class _SqlalchemyQuery:
    def __init__(self, connection: "Connection") -> None:
        self.connection = connection

    def __call__(self, sql: str, **values: Any) -> list[dict[str, Any]]:
        from sqlalchemy import text

        result = self.connection.execute(text(sql), values)
        return [dict(row) for row in result.mappings()] if result.returns_rows else []

    def tuples(self, sql: str, **values: Any) -> Sequence[Sequence[Any]]:
        from sqlalchemy import text

        return self.connection.execute(text(sql), values).all()


def take_write_lock(connection: "Connection") -> None:
    """Keep all other writers waiting until the transaction ends. SQLite has done so at its begin."""
    from sqlalchemy import text

    if connection.dialect.name == "postgresql":
        connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": WRITE_LOCK})


def _revision(query: Query) -> str | None:
    rows = query(f"SELECT version_num FROM {VERSION_TABLE}")
    return rows[0]["version_num"] if rows else None


def _engine(url: Any) -> "Engine":
    """An engine that keeps no connection open. Raises StoreError for a URL that is none."""
    from sqlalchemy import NullPool, create_engine, exc

    # Without it psycopg asks every new connection for a type that the catalog does not use.
    options = {"use_native_hstore": False} if str(url).startswith("postgresql+psycopg") else {}
    try:
        engine = create_engine(url, poolclass=NullPool, **options)
    except ModuleNotFoundError as error:
        cure = f"`pip install {'psycopg[binary]' if 'psycopg' in str(error.name) else error.name}`"
        raise MissingDependencyError(f"the catalog's database needs the package {error.name}; {cure}") from error
    except exc.SQLAlchemyError as error:
        raise StoreError(f"catalog: {error}; give a URL such as sqlite:///catalog.sqlite") from error
    if engine.dialect.name == "sqlite":
        _take_lock_at_begin(engine)
    return engine


def _take_lock_at_begin(engine: "Engine") -> None:
    """Make SQLite's transactions begin where SQLAlchemy's do, with the write lock (the driver begins late)."""
    from sqlalchemy import event

    @event.listens_for(engine, "connect")
    def _(connection: sqlite3.Connection, _record: object) -> None:
        connection.isolation_level = None
        for pragma in PRAGMAS:
            connection.execute(pragma)

    @event.listens_for(engine, "begin")
    def _(connection: "Connection") -> None:
        connection.exec_driver_sql("BEGIN IMMEDIATE")


def _conflict(name: str, error: object) -> ConflictError:
    return ConflictError(f"{name}: somebody else changed it at the same time ({_first_line(error)}); run it again")


def _unusable(name: str, error: object) -> StoreError:
    cure = "check that it is reachable, writable and undamaged"
    return StoreError(f"{name}: the catalog cannot be used: {_first_line(error)}; {cure}")


def _first_line(error: object) -> str:
    return next(iter(str(error).strip().splitlines()), type(error).__name__)
