"""Alembic's environment: the scripts run on the connection, and in the transaction, of the caller."""

from __future__ import annotations

from alembic import context

from hsloc_service.db.tables import Base

context.configure(connection=context.config.attributes["connection"], target_metadata=Base.metadata)
context.run_migrations()
