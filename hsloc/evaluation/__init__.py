"""HOW WELL: errors against truth, and what can be said without it."""
