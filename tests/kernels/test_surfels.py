"""Hits that stand alone, and where hits are, against plain versions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hsloc.kernels.surfels import drop_isolated, place_hits

if TYPE_CHECKING:
    from numpy.typing import NDArray

LIMITS = np.array((0.1, 30.0), dtype=np.float32)
SPACING = np.radians(1.0)
READINGS = st.one_of(st.floats(0.0, 40.0, width=32), st.sampled_from((np.nan, np.inf, -np.inf)))


def plainly(ranges: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which hits are isolated, from the points themselves."""
    with np.errstate(invalid="ignore"):
        hit = np.isfinite(ranges) & (ranges >= LIMITS[0]) & (ranges <= LIMITS[1])
    far = ranges.astype(np.float64)
    isolated: NDArray[np.bool_] = hit.copy()
    for i in np.flatnonzero(hit):
        for k in np.flatnonzero(hit):
            apart = abs(int(k) - int(i))
            if 1 <= apart <= 2:
                gap = abs(far[i] - far[k] * np.exp(1j * apart * SPACING))
                isolated[i] &= gap > 0.1 + 6.0 * apart * SPACING * min(far[i], far[k])
    return isolated


@given(st.lists(READINGS, max_size=40))
def test_isolated_hits_are_those_of_the_plain_version(readings: list[float]) -> None:
    ranges = np.array(readings, dtype=np.float32)
    kept = np.empty_like(ranges)
    hits, isolated = drop_isolated(ranges, LIMITS, SPACING, kept)
    expected = plainly(ranges)
    assert isolated == expected.sum()
    assert np.isnan(kept[expected]).all()
    assert np.array_equal(kept[~expected], ranges[~expected], equal_nan=True)
    with np.errstate(invalid="ignore"):
        assert hits == (np.isfinite(ranges) & (ranges >= LIMITS[0]) & (ranges <= LIMITS[1])).sum()


def test_a_wall_at_a_grazing_angle_and_a_post_of_two_beams_are_kept() -> None:
    angles = np.radians(np.arange(10.0, 170.0))
    ranges = (1.0 / np.sin(angles)).astype(np.float32)
    ranges[80:82] = 0.6
    ranges[40] = 0.3
    kept = np.empty_like(ranges)
    assert drop_isolated(ranges, LIMITS, SPACING, kept) == (160, 1)
    assert np.isnan(kept[40])


def test_hits_are_placed_to_the_last_bit_as_array_arithmetic_places_them(rng: np.random.Generator) -> None:
    ranges = rng.uniform(0.0, 12.0, 200).astype(np.float32)
    ranges[rng.integers(0, 200, 30)] = rng.choice(np.array([np.nan, np.inf, -np.inf, 0.1, 10.0], np.float32), 30)
    directions, points = rng.normal(size=(200, 2)), np.full((200, 2), np.nan)
    x, y, c, s = 0.3, -0.2, np.cos(0.7), np.sin(0.7)
    hits = np.isfinite(ranges) & (ranges >= np.float32(0.1)) & (ranges <= np.float32(10.0))
    assert place_hits(ranges, (0.1, 10.0), directions, (x, y, float(c), float(s)), points) == hits.sum() > 100
    ahead, aside = (ranges[hits].astype(np.float64)[:, None] * directions[hits]).T
    expected = np.column_stack((x + c * ahead - s * aside, y + s * ahead + c * aside))
    assert points[: hits.sum()].tobytes() == expected.tobytes()
    assert np.isnan(points[hits.sum() :]).all()
