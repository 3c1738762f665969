"""Sums over pairs of keyscans, or of places: at each of them, and across each step."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]


def summed_at(n: int, pairs: I64, weights: F64) -> F64:
    """For each of n the sum (n,) of the `weights` (m,) of the pairs (m, 2) that it is in."""
    sums = np.bincount(pairs.reshape(-1), weights=np.repeat(weights, 2), minlength=n)
    return np.asarray(sums, dtype=np.float64)


def summed_across(n: int, pairs: I64, weights: F64) -> F64:
    """For the step to each of n from the one before the sum (n, ...) of the `weights` (m, ...) of pairs around it."""
    change = np.zeros((n + 1, *weights.shape[1:]))
    np.add.at(change, pairs.min(axis=1) + 1, weights)
    np.add.at(change, pairs.max(axis=1) + 1, -weights)
    return np.asarray(np.cumsum(change, axis=0)[:n], dtype=np.float64)
