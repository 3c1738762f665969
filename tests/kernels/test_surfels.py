"""Hits that stand alone, where hits are and the walls around them, against plain versions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hsloc.kernels import surfels
from hsloc.kernels.surfels import drop_isolated, fit_surfels, place_hits

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


Fitted = tuple["NDArray[np.float32]", "NDArray[np.float32]"]
ORIGIN = np.zeros(2)
CORNERS = np.array(((-6.0, 1.0), (1.5, 1.0), (1.5, 1.4), (2.7, 1.4), (2.7, 1.0), (6.0, 1.0), (6.0, -1.0), (-6.0, -1.0)))


def corridor(noise: float, seed: int) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Hits (n, 2) of a full turn in a corridor 2 m wide with a recess of 0.4 m on the left, and their true normals."""
    angles = np.radians(np.arange(-179.5, 180.0))
    directions = np.column_stack((np.cos(angles), np.sin(angles)))
    ranges, normals = np.full(360, np.inf), np.zeros((360, 2))
    for first, second in zip(CORNERS, np.roll(CORNERS, -1, axis=0), strict=True):
        along = second - first
        across = np.array((along[1], -along[0])) / np.hypot(*along)
        distance = (first @ across) / (directions @ across)
        part = (directions * distance[:, None] - first) @ along / (along @ along)
        nearer = (distance > 0.0) & (distance < ranges) & (part >= 0.0) & (part <= 1.0)
        ranges[nearer], normals[nearer] = distance[nearer], across
    ranges = ranges + noise * np.random.default_rng(seed).standard_normal(360)
    return (directions * ranges[:, None]).astype(np.float32), normals


def fitted(points: NDArray[np.float32]) -> Fitted:
    normals, centroids = np.empty_like(points), np.empty_like(points)
    fit_surfels(points, np.arange(len(points), dtype=np.int32), SPACING, 0.2, normals, centroids, ORIGIN)
    return normals, centroids


@pytest.mark.parametrize(("noise", "within_deg"), [(0.0, 5.0), (0.003, 8.0)])
def test_a_line_is_of_one_wall_also_beside_corners(noise: float, within_deg: float) -> None:
    """But for hits so near to a corner that they lie on both walls, within their noise and what is uneven."""
    points, true = corridor(noise, 1)
    normals, centroids = fitted(points)
    has_line = np.hypot(*normals.T) > 0.0
    assert has_line.mean() > 0.97
    corners = CORNERS[:, None] - points
    inside = has_line & (np.hypot(*corners.transpose(2, 0, 1)).min(axis=0) > 0.03)
    assert inside.mean() > 0.95
    cosines = (normals * true).sum(axis=1)[inside]
    assert cosines.min() > np.cos(np.radians(within_deg))
    off = ((points - centroids) * true).sum(axis=1)[inside]
    assert np.abs(off).max() < surfels._BENT * surfels._UNEVEN_M + 4.0 * noise


def plain_line(points: NDArray[np.float64], i: int, least: tuple[int, int]) -> tuple[NDArray[np.float64], ...] | None:
    """Centroid, normal and (variance across, cosine, distance) of the hits around hit i."""
    members = [i]
    for direction, fewest in zip((-1, 1), least, strict=True):
        for step in range(16 if fewest else 0):
            k = i + direction * (step + 1)
            if not 0 <= k < len(points):
                break
            gap = np.hypot(*(points[k] - points[k - direction]))
            beyond = np.hypot(*(points[k] - points[i])) > 0.2
            if gap > min(0.1 + 4.0 * SPACING * np.hypot(*points[k]), 0.8) or (step >= fewest and beyond):
                break
            members.append(k)
    if len(members) < 4:
        return None
    values, vectors = np.linalg.eigh(np.cov(points[members].T, bias=True))
    if values[0] > 0.06**2 or values[0] > 0.08 * values[1]:
        return None
    normal = vectors[:, 0] * (-1.0 if vectors[:, 0] @ points[i] > 0.0 else 1.0)
    away = np.hypot(*points[i])
    across = values[0] * len(members) / (len(members) - 2)
    return points[members].mean(axis=0), normal, np.array((across, -(normal @ points[i]) / away, away))


@pytest.mark.parametrize("noise", [0.003, 0.01, 0.03])
def test_lines_are_those_of_the_plain_version(noise: float) -> None:
    hits, _ = corridor(noise, 2)
    normals, centroids = fitted(hits)
    points = hits.astype(np.float64)
    around = [plain_line(points, i, (2, 2)) for i in range(len(points))]
    known = np.array([line[2] for line in around if line is not None])
    variances = known[:, 0] / np.maximum(known[:, 1], 0.3) ** 2
    near = known[:, 2] <= np.median(known[:, 2])
    at = [np.median(known[half, 2]) ** 2 for half in (near, ~near)]
    level = [np.median(variances[half]) for half in (near, ~near)]
    slope = max(level[1] - level[0], 0.0) / (at[1] - at[0])
    constant = level[0] - slope * at[0]
    if constant < 0.0:
        constant, slope = 0.0, level[0] / at[0]

    def bend(spread: NDArray[np.float64]) -> float:
        return float(spread[0] / (2.5**2 * ((constant + slope * spread[2] ** 2) * spread[1] ** 2 + 0.005**2)))

    one_sided = 0
    for i, line in enumerate(around):
        if line is None or bend(line[2]) > 1.0:
            sides = [plain_line(points, i, least) for least in ((3, 0), (0, 3))]
            straight = [side for side in sides if side is not None and bend(side[2]) <= 1.0]
            one_sided += len(straight) > 0
            kept = [line] if line is not None and line[2][0] <= 0.03**2 else []
            line = min(straight, key=lambda side: bend(side[2]), default=None) or next(iter(kept), None)
        if line is None:
            assert (normals[i] == 0.0).all()
            continue
        np.testing.assert_allclose(normals[i], line[1], atol=2e-5)
        np.testing.assert_allclose(centroids[i], line[0], atol=2e-6)
    assert one_sided > 5


def test_without_enough_lines_to_know_the_noise_by_they_are_left() -> None:
    points, _ = corridor(0.003, 3)
    few = points[80:98]
    normals, _ = fitted(few)
    assert len(few) < surfels._FEWEST_LINES
    assert (np.hypot(*normals.T) > 0.0).all()
