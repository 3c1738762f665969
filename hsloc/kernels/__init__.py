"""COMPILED: the only package that imports numba. Arrays in, arrays out."""
