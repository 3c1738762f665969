"""Checks of a recording before it is replayed."""
