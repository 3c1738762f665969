"""The command line: one module a command."""

import time

BEGIN = time.perf_counter()
"""When the program began, but for Python's own start [s]."""
