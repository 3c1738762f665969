"""The HTTP service: upload a log, get the answer."""
