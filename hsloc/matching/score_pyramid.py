"""The tables of a field's maxima that the bounds look up, made once for a field and kept as long as it lives."""

from __future__ import annotations

import weakref
from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.box_bounds import Pyramid

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.matching.likelihood_field import LikelihoodField

    U8 = NDArray[np.uint8]

SIZES = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 48, 64)
"""Of the squares, in entries; each but the first at most twice the one before."""
BORDER = 128
_ENTRIES = 4e6
"""Of a table, at most, with every node an entry; larger fields are halved in both directions until they fit."""

_pyramids: weakref.WeakKeyDictionary[LikelihoodField, Pyramid] = weakref.WeakKeyDictionary()


def score_pyramid(field: LikelihoodField) -> Pyramid:
    """The tables of a field; some 60 MB at most below 4 million cells, the same share of a byte a cell above."""
    pyramid = _pyramids.get(field)
    if pyramid is None:
        shift = 0
        while field.packed.shape[0] * field.packed.shape[1] > _ENTRIES * 4**shift and shift < 2:
            shift += 1
        pyramid = _pyramids[field] = make_pyramid(field.packed, shift)
    return pyramid


def make_pyramid(packed: NDArray[np.float32], shift: int) -> Pyramid:
    """Tables of the maxima over squares of the nodes of a packed field; an entry covers 2^shift x 2^shift nodes."""
    entries = _entries(packed, shift)
    border = max(SIZES[-1], BORDER >> shift)
    shape = (len(SIZES), entries.shape[0] + 2 * border, entries.shape[1] + 2 * border)
    tables = np.zeros(shape, dtype=np.uint8)
    tables[0, border:-border, border:-border] = entries
    for k in range(1, len(SIZES)):
        before, more = tables[k - 1], SIZES[k] - SIZES[k - 1]
        rows = before.copy()
        np.maximum(rows[:-more], before[more:], out=rows[:-more])
        tables[k] = rows
        np.maximum(tables[k, :, :-more], rows[:, more:], out=tables[k, :, :-more])
    smallest = np.searchsorted(SIZES, np.arange(SIZES[-1] + 1)).astype(np.int64)
    return Pyramid(tables, smallest, border, shift)


def _entries(packed: NDArray[np.float32], shift: int) -> U8:
    """The nodes' scores in steps of 1 / 255, rounded up; maxima of 2^shift x 2^shift of them."""
    height, width = packed.shape[0] + 1, packed.shape[1] + 1
    step = 1 << shift
    entries = np.empty((-(-height // step), -(-width // step)), dtype=np.uint8)
    # Some rows at a time: floats and padding of the whole field would take more memory than the tables.
    part = max((1 << 20) // (width * step), 1)
    for first in range(0, len(entries), part):
        last = min(first + part, len(entries))
        padded = np.zeros(((last - first) * step, entries.shape[1] * step), dtype=np.uint8)
        squares = packed[first * step : last * step]
        padded[: len(squares), : width - 1] = _steps(squares[..., 0])
        padded[: len(squares), width - 1] = _steps(squares[:, -1, :2].sum(axis=1))
        if last == len(entries):
            bottom = padded[height - 1 - first * step]
            bottom[: width - 1] = _steps(packed[-1, :, 0] + packed[-1, :, 2])
            bottom[width - 1] = _steps(packed[-1, -1].sum())
        entries[first:last] = padded.reshape(last - first, step, entries.shape[1], step).max(axis=(1, 3))
    return entries


def _steps(scores: NDArray[np.float32]) -> NDArray[np.float32]:
    """Rounded up by at least the rounding of the sums, so that no score is above its step."""
    steps: NDArray[np.float32] = np.clip(np.ceil(scores * np.float32(255.0) + np.float32(1e-4)), 0.0, 255.0)
    return steps
