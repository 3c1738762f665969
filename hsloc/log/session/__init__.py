"""A log that is open: topics, transforms, order of events."""
