"""Tile states: one row a tile with all that `presight status` shows, so that it reads no history and no JSON."""

import json
from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"

TIME = sa.String(27)  # 2026-11-22T06:15:00.000000Z


def upgrade() -> None:
    """Make the table and fill it from the builds of before."""
    states = op.create_table(
        "tile_states",
        sa.Column("city", sa.Text, primary_key=True),
        sa.Column("tile_id", sa.Text, primary_key=True),
        # What the last plan said.
        sa.Column("reasons", sa.Text, nullable=False, server_default=""),  # empty: current
        sa.Column("plan_digest", sa.Text, nullable=False, server_default=""),
        sa.Column("drive_count", sa.Integer, nullable=False, server_default="0"),
        sa.Column("frame_count", sa.Integer, nullable=False, server_default="0"),
        sa.Column("planned_at", TIME),
        # The newest build.
        sa.Column("state", sa.Text, nullable=False, server_default=""),  # empty: none yet
        sa.Column("stage", sa.Text, nullable=False, server_default=""),
        sa.Column("done", sa.BigInteger, nullable=False, server_default="0"),
        sa.Column("total", sa.BigInteger, nullable=False, server_default="0"),
        sa.Column("stage_at", TIME),  # when the stage began, and at which unit of it: a resumed one begins late
        sa.Column("stage_done", sa.BigInteger, nullable=False, server_default="0"),
        sa.Column("error", sa.Text, nullable=False, server_default=""),
        sa.Column("started_at", TIME),
        sa.Column("updated_at", TIME),
        # The build that the prior shows.
        sa.Column("voxels", sa.BigInteger),
        sa.Column("psnr_db", sa.Double),
        sa.Column("generation", sa.BigInteger),
        sa.Column("published_at", TIME),
        sqlite_with_rowid=False,  # kept in the order of the key, in which every question reads it
    )
    # The overview counts drives from this alone; it also serves what drives_of_city did.
    op.create_index("drives_by_time", "drives", ["city", "removed_at", "added_at"])
    op.drop_index("drives_of_city", "drives")
    rows = op.get_bind().execute(sa.text(OLD_BUILDS)).mappings()
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for row in rows:
        state = found.setdefault((row["city"], row["tile_id"]), dict.fromkeys(PUBLISHED))
        state |= {name: row[name] for name in NEWEST}
        if row["state"] == "published":
            metrics = json.loads(row["metrics"])
            state |= {name: metrics.get(name) for name in PUBLISHED[:3]} | {"published_at": row["finished_at"]}
    if found:
        op.bulk_insert(states, list(found.values()))


def downgrade() -> None:
    """Drop the table."""
    op.create_index("drives_of_city", "drives", ["city"])
    op.drop_index("drives_by_time", "drives")
    op.drop_table("tile_states")


NEWEST = ("city", "tile_id", "state", "stage", "done", "total", "error", "started_at", "updated_at")
PUBLISHED = ("voxels", "psnr_db", "generation", "published_at")
OLD_BUILDS = f"SELECT {', '.join(NEWEST)}, metrics, finished_at FROM builds ORDER BY build_id"
