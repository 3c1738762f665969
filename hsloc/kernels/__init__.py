"""INNER LOOPS: the only code that numba compiles. Each kernel has a naive twin in the tests."""

from hsloc.kernels.cache import choose_cache

choose_cache()
