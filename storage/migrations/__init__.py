"""The catalog's schema, as Alembic migrations."""

HEAD = "0002"  # the newest revision under versions/; known here so that nothing need import Alembic to compare
