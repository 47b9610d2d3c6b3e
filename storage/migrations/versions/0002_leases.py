"""Leases: who may build a city, and until when; every build names the lease that it runs under."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"

TIME = sa.String(27)  # 2026-11-22T06:15:00.000000Z


def upgrade() -> None:
    """Make the table of leases; builds of before have no lease."""
    op.create_table(
        "leases",
        sa.Column("city", sa.Text, primary_key=True),
        sa.Column("token", sa.BigInteger, nullable=False),  # fencing number: only ever grows
        sa.Column("owner", sa.Text, nullable=False),
        sa.Column("acquired_at", TIME, nullable=False),
        sa.Column("heartbeat_at", TIME, nullable=False),
        sa.Column("expires_at", TIME, nullable=False),
        sa.Column("ended_at", TIME),  # null: held, or lost once expires_at has passed
    )
    op.add_column("builds", sa.Column("lease_token", sa.BigInteger))
    op.create_index("builds_by_state", "builds", ["state", "city"])


def downgrade() -> None:
    """Drop the leases."""
    op.drop_index("builds_by_state", "builds")
    op.drop_column("builds", "lease_token")
    op.drop_table("leases")
