"""Servers and workers that share the database, uploads in an object store (two new tables), and tags of jobs."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "5"
down_revision = "4"


def upgrade() -> None:
    """Add the column; tables that are new are made afterwards, see `migrations`."""
    op.add_column("job", sa.Column("tag", sa.String(), nullable=True))
