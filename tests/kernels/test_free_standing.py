"""Things that stand free are found as by a plain search of runs of beams."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hsloc.kernels.free_standing import find_free_standing

LIMITS = np.array((0.1, 10.0), dtype=np.float32)
SIZES = (2.5, 0.3, 1.2)


def plainly(ranges: list[float], directions: np.ndarray, is_turn: bool) -> list[tuple[int, int, float, float]]:
    """The same with lists: beams are cut into runs, of which those are kept that are free, narrow and wide enough."""
    n, (reach, gap, widest) = len(ranges), SIZES
    seen = [r if LIMITS[0] <= r <= LIMITS[1] else np.inf for r in np.array(ranges, dtype=np.float32).tolist()]
    near = [r <= reach for r in seen]

    def joins(k: int) -> bool:  # beam k and the one after it
        if k == n - 1 and not is_turn:
            return False
        return near[k] and near[(k + 1) % n] and abs(seen[k] - seen[(k + 1) % n]) <= gap

    found = []
    for first in range(n):
        if not near[first] or joins((first - 1) % n) or (first == 0 and not is_turn):
            continue
        last = first
        while joins(last % n) and last - first < n - 1:
            last += 1
        if (last >= n - 1 and not is_turn) or last - first == n - 1:
            continue
        points = np.array([seen[k % n] * directions[k % n] for k in range(first, last + 1)])
        before, after = seen[first - 1], seen[(last + 1) % n]
        hidden = before < seen[first], after < seen[last % n]
        beside = abs(before - seen[first]) > gap, abs(after - seen[last % n]) > gap
        if all(beside) and not all(hidden) and last > first and np.hypot(*(points[-1] - points[0])) <= widest:
            found.append((first, last, *points.mean(axis=0)))
    return found


@settings(max_examples=400, deadline=None)
@given(
    st.lists(
        st.sampled_from((0.05, 0.5, 0.7, 0.9, 1.0, 1.4, 2.0, 2.4, 2.6, 5.0, 9.0, np.inf, np.nan)),
        min_size=3,
        max_size=40,
    ),
    st.booleans(),
)
def test_things_are_those_of_a_plain_search(ranges: list[float], is_turn: bool) -> None:
    angles = np.linspace(-np.pi, np.pi, len(ranges), endpoint=False) * (1.0 if is_turn else 0.7)
    directions = np.column_stack((np.cos(angles), np.sin(angles)))
    found = np.full((len(ranges), 4), np.nan)
    count = find_free_standing(np.array(ranges, dtype=np.float32), LIMITS, directions, is_turn, SIZES, found)
    expected = plainly(ranges, directions, is_turn)
    assert count == len(expected)
    np.testing.assert_allclose(found[:count], np.array(expected).reshape(-1, 4), atol=1e-6)


@pytest.mark.parametrize(("is_turn", "count"), [(True, 1), (False, 0)])
def test_a_thing_may_lie_across_the_last_beam_of_a_whole_turn(is_turn: bool, count: int) -> None:
    ranges = np.full(360, 5.0, dtype=np.float32)
    ranges[:5] = ranges[-5:] = 1.0
    angles = np.radians(np.arange(360.0))
    found = np.empty((360, 4))
    directions = np.column_stack((np.cos(angles), np.sin(angles)))
    assert find_free_standing(ranges, LIMITS, directions, is_turn, SIZES, found) == count
    if count:
        np.testing.assert_allclose(found[0], (355, 364, 0.998, -0.0087), atol=1e-3)
