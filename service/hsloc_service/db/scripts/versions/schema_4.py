"""The first schema that Alembic knows; what leads from 1 to 3, which were SQLite's alone, is in `migrations`."""

from __future__ import annotations

revision = "4"
down_revision = None


def upgrade() -> None:
    """Nothing: older databases are brought here before, new ones are made of today's tables."""
