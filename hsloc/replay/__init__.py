"""THE SHELL: events in, estimates out; one call from a log to a result."""
