"""Numbers of a view: as many figures as can be seen, for a page has tens of thousands of them."""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]


def columns(*, decimals: int = 3, **values: Floats) -> dict[str, Any]:
    """Columns (n,) by their names, rounded."""
    return {name: numbers(column, decimals) for name, column in values.items()}


def numbers(values: Floats, decimals: int) -> list[float | None]:
    """Rounded; what is not a number is null."""
    found = np.round(np.asarray(values, dtype=np.float64), decimals)
    found += 0.0  # no -0.0
    return [value if known else None for value, known in zip(found.tolist(), np.isfinite(found).tolist(), strict=True)]


def significant(values: Floats) -> list[float | None]:
    """Five figures, which are enough to read."""
    return [float(f"{value:.5g}") if isfinite(value) else None for value in values.tolist()]


def rounded(value: float) -> float:
    """To a thousandth."""
    return round(float(value), 3)
