"""Results on disk: folder, run.mcap, provenance."""
