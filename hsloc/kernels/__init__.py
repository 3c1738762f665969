"""Compiled kernels on arrays, the only code that numba compiles; each has a plain version in the tests."""

from hsloc.kernels.cache import choose_cache, compare_all_sources, load_without_compiler
from hsloc.kernels.uninterrupted import hold_back_interrupts

compare_all_sources()
load_without_compiler()
choose_cache()
hold_back_interrupts()
