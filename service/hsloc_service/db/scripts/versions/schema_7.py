"""Titles, labels and notes of jobs, and links by which they are shared (a new table)."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "7"
down_revision = "6"


def upgrade() -> None:
    """Add the columns; tables that are new are made afterwards, see `migrations`."""
    op.add_column("job", sa.Column("title", sa.String(), nullable=True))
    op.add_column("job", sa.Column("labels", sa.String(), nullable=False, server_default=","))
    op.add_column("job", sa.Column("notes", sa.String(), nullable=True))
