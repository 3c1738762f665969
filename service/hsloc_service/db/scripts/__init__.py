"""Alembic's scripts: `env` runs them on the connection of `migrations`, `versions` has one for each schema."""
