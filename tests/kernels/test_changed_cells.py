"""Beams that end in cells, and pass through them, against a version that cuts each beam with each cell."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from hsloc.kernels.changed_cells import ACROSS, count_beams, count_scan

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F64 = NDArray[np.float64]

SHAPE = (9, 12)
MARGIN = 1.7


def counters() -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
    return np.zeros(SHAPE, dtype=np.uint16), np.zeros(SHAPE, dtype=np.uint16)


def passed(origin: F64, end: F64) -> set[tuple[int, int]]:
    """Cells (row, column) with a part of the beam, but for its last `MARGIN`, by the slabs of each."""
    way = end - origin
    length = float(np.hypot(*way))
    last = 1.0 - MARGIN / length
    found = set()
    for row in range(SHAPE[0]):
        for column in range(SHAPE[1]):
            low, high = 0.0, last
            for at, step, first in ((origin[0], way[0], column), (origin[1], way[1], row)):
                near, far = sorted(((first - at) / step, (first + 1 - at) / step))
                low, high = max(low, near), min(high, far)
            if low < high:
                found.add((row, column))
    return found


def beams(rng: np.random.Generator, n: int) -> tuple[F64, F64]:
    """A laser in or beside the grid, and ends in and around it."""
    return rng.uniform((-2.0, -2.0), (14.0, 11.0)), rng.uniform((-4.0, -4.0), (16.0, 13.0), (n, 2))


def test_each_scan_counts_once_in_each_cell(rng: np.random.Generator) -> None:
    ended, seen = counters(), counters()
    by_hand = np.zeros((2, *SHAPE), dtype=np.int64)
    for number in range(1, 6):
        origin, ends = beams(rng, 25)
        is_hit = rng.random(25) < 0.7
        count_scan(number, ended, seen, origin, ends, is_hit, MARGIN)
        hits = {(int(np.floor(v)), int(np.floor(u))) for (u, v), hit in zip(ends, is_hit, strict=True) if hit}
        hits = {(v, u) for v, u in hits if 0 <= v < SHAPE[0] and 0 <= u < SHAPE[1]}
        far = [end for end in ends if np.hypot(*(end - origin)) > MARGIN]
        for cell in hits:
            by_hand[0][cell] += 1
        for cell in hits.union(*(passed(origin, end) for end in far)):
            by_hand[1][cell] += 1
    np.testing.assert_array_equal(ended[0], by_hand[0])
    np.testing.assert_array_equal(seen[0], by_hand[1])
    assert by_hand.max() >= 3


@pytest.mark.parametrize("is_thin", [False, True])
def test_beams_that_end_in_a_thing_or_lead_across_it_are_counted(is_thin: bool, rng: np.random.Generator) -> None:
    labels = np.zeros(SHAPE, dtype=np.int32)
    labels[2, 3:9], labels[6:8, 5:7] = 1, 2
    along = np.zeros((3, 2))
    if is_thin:
        along[1] = (1.0, 0.0)
    ended, crossed = np.zeros(3, dtype=np.int64), np.zeros(3, dtype=np.int64)
    by_hand = np.zeros((2, 3), dtype=np.int64)
    for _ in range(10):
        origin, ends = beams(rng, 30)
        count_beams(labels, along, origin, ends, MARGIN, ended, crossed)
        for end in ends:
            u, v = np.floor(end).astype(int)
            if 0 <= v < SHAPE[0] and 0 <= u < SHAPE[1]:
                by_hand[0, labels[v, u]] += 1
            way = end - origin
            if (length := float(np.hypot(*way))) <= MARGIN:
                continue
            for label in {int(labels[cell]) for cell in passed(origin, end)} - {0}:
                if label == 2 or not is_thin or abs(way[1]) >= ACROSS * length:
                    by_hand[1, label] += 1
    np.testing.assert_array_equal(ended[1:], by_hand[0, 1:])
    np.testing.assert_array_equal(crossed[1:], by_hand[1, 1:])
    assert by_hand[0, 1:].min() > 0
    assert by_hand[1, 1:].min() > 10
