"""The catalog's schema, as Alembic migrations."""

HEAD = "0003"  # the newest revision under versions/; known here so that nothing need import Alembic to compare
