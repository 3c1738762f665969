"""Uploads: rows, and bytes on disk."""
