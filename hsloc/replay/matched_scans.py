"""Which scans of a run were matched, and whether that is most of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.model.estimate import Status

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray


def are_matched(status: Sequence[str]) -> NDArray[np.bool_]:
    """Which of n scans were matched, shape (n,), by the `status` of each."""
    return np.isin(np.array(status, dtype=str), (Status.MATCHED.value, Status.RELOCALISED.value))


def is_lost(status: Sequence[str]) -> bool:
    """Whether most scans that were to be matched found no match; those the motion gate passed over were not to be."""
    tried = len(status) - status.count(Status.PREDICTED.value)
    return bool(2 * np.count_nonzero(are_matched(status)) < tried)


def mean_fitness(fitness: NDArray[np.float64]) -> float:
    """Of the scans that were matched, NaN being none; 0 without any."""
    known = fitness[np.isfinite(fitness)]
    return float(known.mean()) if len(known) else 0.0
