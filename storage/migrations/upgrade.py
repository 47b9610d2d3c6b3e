"""Bring a catalog's schema to the newest revision."""

from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.util.exc import CommandError
from sqlalchemy import exc

from presight_core.errors import StoreError
from storage.database import Database, take_write_lock


def upgrade(database: Database) -> None:
    """Apply what migrations are missing, all or nothing, while others that want to do the same wait.

    Raises StoreError if the database refuses or its schema is newer than this program.
    """
    config = Config()
    config.set_main_option("script_location", str(Path(__file__).parent).replace("%", "%%"))
    engine = database.engine()
    try:
        with engine.begin() as connection:
            take_write_lock(connection)
            config.attributes["connection"] = connection
            command.upgrade(config, "head")
    except CommandError as error:
        raise StoreError(f"catalog: made by a newer version of presight ({error}); upgrade this program") from error
    except exc.SQLAlchemyError as error:
        raise StoreError(
            f"catalog: its schema cannot be made: {str(error).splitlines()[0]}; check the database's rights"
        ) from error
