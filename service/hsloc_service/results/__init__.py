"""Results: data folder or object store."""
