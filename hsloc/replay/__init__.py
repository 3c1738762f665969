"""Replay: from a log to a result in one call."""
