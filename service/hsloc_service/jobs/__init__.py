"""Jobs: rows, leases, events."""
