"""Drives, rejects, tilings, tiles and builds.

Times are UTC in ISO 8601 with microseconds, so that they sort as text; values that only people and Python read are
JSON in text. Both are the same in SQLite and PostgreSQL.
"""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None

TIME = sa.String(27)  # 2026-11-22T06:15:00.000000Z


def upgrade() -> None:
    """Make the first tables."""
    op.create_table(
        "drives",
        sa.Column("drive_id", sa.String(64), primary_key=True),
        sa.Column("name", sa.Text, nullable=False),
        sa.Column("city", sa.Text, nullable=False),
        sa.Column("root", sa.Text, nullable=False),
        sa.Column("version", sa.Text, nullable=False),
        sa.Column("captured", sa.Text, nullable=False),
        sa.Column("frame_count", sa.BigInteger, nullable=False),
        sa.Column("start_us", sa.BigInteger, nullable=False),
        sa.Column("end_us", sa.BigInteger, nullable=False),
        sa.Column("added_at", TIME, nullable=False),
        sa.Column("removed_at", TIME),  # null: part of the city
    )
    op.create_index("drives_of_city", "drives", ["city"])
    op.create_table(
        "rejects",
        sa.Column("reject_id", sa.BigInteger().with_variant(sa.Integer, "sqlite"), primary_key=True),
        sa.Column("drive_id", sa.String(64), sa.ForeignKey("drives.drive_id"), nullable=False),
        sa.Column("code", sa.Text, nullable=False),
        sa.Column("file", sa.Text, nullable=False),
        sa.Column("detail", sa.Text, nullable=False),
        sa.Column("cure", sa.Text, nullable=False),
        sa.Column("drive", sa.Text, nullable=False),
    )
    op.create_index("rejects_of_drive", "rejects", ["drive_id"])
    _create_tilings()
    _create_builds()


def _create_tilings() -> None:
    op.create_table(
        "tilings",
        sa.Column("tiling_number", sa.BigInteger().with_variant(sa.Integer, "sqlite"), primary_key=True),
        sa.Column("city", sa.Text, nullable=False),
        sa.Column("tiling_id", sa.Text, nullable=False),
        sa.Column("settings", sa.Text, nullable=False),  # JSON
        sa.Column("created_at", TIME, nullable=False),
        sa.UniqueConstraint("city", "tiling_id", name="one_tiling_of_a_name"),
    )
    op.create_table(
        "tiles",
        sa.Column("tiling_number", sa.BigInteger, sa.ForeignKey("tilings.tiling_number"), primary_key=True),
        sa.Column("place", sa.Integer, primary_key=True, autoincrement=False),  # 0, 1, 2 ... in the tiling's order
        sa.Column("tile_id", sa.Text, nullable=False),
        sa.Column("x_m", sa.Double, nullable=False),
        sa.Column("y_m", sa.Double, nullable=False),
        sa.UniqueConstraint("tiling_number", "tile_id", name="one_tile_of_a_name"),
    )


def _create_builds() -> None:
    op.create_table(
        "builds",
        sa.Column("build_id", sa.BigInteger().with_variant(sa.Integer, "sqlite"), primary_key=True),
        sa.Column("city", sa.Text, nullable=False),
        sa.Column("tile_id", sa.Text, nullable=False),
        sa.Column("recipe", sa.Text, nullable=False),  # JSON
        sa.Column("recipe_digest", sa.Text, nullable=False),
        sa.Column("state", sa.Text, nullable=False),
        sa.Column("stage", sa.Text, nullable=False),
        sa.Column("done", sa.BigInteger, nullable=False),
        sa.Column("total", sa.BigInteger, nullable=False),
        sa.Column("figures", sa.Text, nullable=False),  # JSON
        sa.Column("metrics", sa.Text, nullable=False),  # JSON
        sa.Column("error", sa.Text, nullable=False),
        sa.Column("started_at", TIME, nullable=False),
        sa.Column("updated_at", TIME, nullable=False),
        sa.Column("finished_at", TIME),
        sqlite_autoincrement=True,  # an id is never given twice
    )
    op.create_index("builds_of_tile", "builds", ["city", "tile_id", "build_id"])


def downgrade() -> None:
    """Drop everything."""
    for table in ("builds", "tiles", "tilings", "rejects", "drives"):
        op.drop_table(table)
