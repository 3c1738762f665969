"""Benchmarks: the figures that the project promises, measured on this machine, and other programs on the same work."""
