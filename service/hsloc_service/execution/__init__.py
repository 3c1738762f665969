"""Running jobs: dispatcher, supervised processes, the worker."""
