"""Indexes for what read all rows of a tenant or a table: claims, old jobs, a page of jobs by name, due webhooks."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "8"
down_revision = "7"


def upgrade() -> None:
    """Add the indexes; an older server need not know them."""
    op.create_index("job_waiting", "job", ["tenant", "state", sa.text("priority DESC"), "seq"])
    op.create_index("job_by_end", "job", ["ended", "seq"])
    op.create_index("job_by_name", "job", ["tenant", sa.text("lower(log_name)"), sa.text("seq DESC")])
    op.create_index("delivery_by_state", "delivery", ["state", "next_at"])
