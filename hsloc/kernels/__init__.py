"""Compiled kernels on arrays; the only package that imports numba."""
