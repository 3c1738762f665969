"""MCAP files: records, index scan, container."""
