"""Priorities, waits before another attempt, sweeps, and an audit log."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "6"
down_revision = "5"


def upgrade() -> None:
    """Add columns that an older server need not know; tables that are new are made afterwards, see `migrations`."""
    op.add_column("job", sa.Column("priority", sa.BigInteger(), nullable=False, server_default="0"))
    op.add_column("job", sa.Column("not_before", sa.Float(), nullable=True))
    op.add_column("job", sa.Column("sweep", sa.String(), nullable=True))
    op.create_index("ix_job_sweep", "job", ["sweep"])
    op.create_index("job_by_start", "job", ["tenant", "started"])
