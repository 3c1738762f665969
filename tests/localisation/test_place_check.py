"""Places compared with each other, and scans explained by a map, in a room that exists once or twice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rooms import L_SHAPE, beside, grid, seen, walls

from hsloc.localisation.place_check import PlaceCheck, PlaceCheckParameters
from hsloc.matching import LikelihoodField
from hsloc.model import OccupancyGrid, PairedScan, Pose2

ONE = [(0.0, 0.0, 9.0, 3.0), (0.0, 0.0, 4.0, 7.0)]
TWO = [*ONE, (20.0, 0.0, 29.0, 3.0), (20.0, 0.0, 24.0, 7.0)]
PLACES = [Pose2(1.5, 5.5, -1.2), Pose2(1.7, 4.5, -1.2), Pose2(2.0, 3.4, -1.0), Pose2(2.4, 2.4, -0.6)]


def check_of(occupancy: OccupancyGrid) -> PlaceCheck:
    return PlaceCheck(occupancy, LikelihoodField.from_grid(occupancy), PlaceCheckParameters())


def rival(check: PlaceCheck, places: list[Pose2]) -> float:
    scans = [(place, check.few(seen(L_SHAPE, place, place, 0.0).points_base())) for place in places]
    return check.compare(scans, places[-1]).rival


def test_a_room_that_exists_once_has_no_rival() -> None:
    assert rival(check_of(grid(L_SHAPE, ONE)), PLACES) <= 0.87


def test_a_room_that_exists_twice_rivals_itself() -> None:
    assert rival(check_of(grid(beside(L_SHAPE, 20.0), TWO)), PLACES) == pytest.approx(1.0, abs=0.06)


def test_mirrored_scans_fit_a_mirrored_map() -> None:
    right = grid(L_SHAPE, ONE)
    scans = [(place, check_of(right).few(seen(L_SHAPE, place, place, 0.0).points_base())) for place in PLACES]
    assert check_of(right).compare(scans, PLACES[-1]).mirrored <= 0.98
    mirrored = replace(right, cells=right.cells[::-1].copy())
    on_mirrored = check_of(mirrored)
    top = 2.0 * right.origin.y + right.cells.shape[0] * right.resolution
    fitting = [(Pose2(p.x, top - p.y, -p.theta), points * (1.0, -1.0)) for p, points in scans]
    assert on_mirrored.compare(fitting, fitting[-1][0]).mirrored <= 0.98  # these have been mirrored, too
    best = max((on_mirrored.compare(scans, place).mirrored for place, _ in fitting), default=0.0)
    assert best > 1.1


def test_a_wrong_place_is_beaten_by_the_right_one() -> None:
    check = check_of(grid(L_SHAPE, ONE))
    off = Pose2(4.6, -3.0, 0.9)
    scans = [(off @ place, check.few(seen(L_SHAPE, place, place, 0.0).points_base())) for place in PLACES]
    ratio, other, mirrored = check.compare(scans, off @ PLACES[-1])
    assert ratio > 1.2
    assert mirrored > 1.0
    assert other is not None
    assert other.distance(PLACES[-1]) < 0.1


def crowded(paired: PairedScan, share: float) -> PairedScan:
    """Every second beam, up to a share of all, ends half-way."""
    ranges = paired.scan.ranges.copy()
    ranges[: int(share * len(ranges))] *= 0.5
    return replace(paired, scan=replace(paired.scan, ranges=ranges))


def test_a_crowd_hides_walls_but_does_not_contradict_them() -> None:
    check = check_of(grid(L_SHAPE, ONE))
    place = PLACES[2]
    clear = check.explain(seen(L_SHAPE, place, Pose2(), 0.0), place)
    crowd = check.explain(crowded(seen(L_SHAPE, place, Pose2(), 0.0), 0.5), place)
    assert clear.fitness > 0.85
    assert (clear.short, clear.through) == (0.0, 0.0)
    assert crowd.fitness == pytest.approx(clear.fitness, abs=0.05)
    assert crowd.short > 0.3
    hidden = crowded(seen(L_SHAPE, place, Pose2(), 0.0), 0.5)
    assert check.is_hidden(hidden, place, clear.fitness)
    assert not check.is_hidden(crowded(hidden, 1.0), place, clear.fitness)
    assert not check.is_hidden(hidden, place @ Pose2(0.3, 0.2), clear.fitness)


def test_the_noise_of_a_low_cost_lidar_takes_nothing_from_what_the_map_explains() -> None:
    check = check_of(grid(L_SHAPE, ONE))
    rng = np.random.default_rng(1)

    def noisy(place: Pose2, at: Pose2) -> float:
        paired = seen(L_SHAPE, place, Pose2(), 0.0, beams=360)
        ranges = (paired.scan.ranges * (1.0 + 0.03 * rng.standard_normal(360))).astype(np.float32)
        return check.explain(replace(paired, scan=replace(paired.scan, ranges=ranges)), at).fitness

    clear = check.explain(seen(L_SHAPE, PLACES[2], Pose2(), 0.0), PLACES[2]).fitness
    assert noisy(PLACES[2], PLACES[2]) == pytest.approx(clear, abs=0.06)
    assert noisy(PLACES[0], Pose2(6.0, 1.5, 2.0)) < 0.85 * clear


def test_what_stands_still_is_seen_again_and_people_are_not() -> None:
    check = check_of(grid(L_SHAPE, ONE))
    crate = np.vstack((L_SHAPE, walls((0.5, 1.0), (1.5, 1.0), (1.5, 1.8), (0.5, 1.8))))
    before, after = PLACES[1], PLACES[2]
    ends = check.explain(seen(crate, before, Pose2(), 0.0), before).ends
    assert len(ends) > 8
    assert np.abs(ends[:, 1] - 1.8).max() < 0.1
    assert check.still_stands(seen(crate, after, Pose2(), 0.0), after, ends) > 0.9
    assert check.still_stands(seen(L_SHAPE, after, Pose2(), 0.0), after, ends) == 0.0
    assert np.isnan(check.still_stands(seen(crate, after, Pose2(), 0.0), after, ends[:3]))


def test_at_a_wrong_place_beams_end_behind_walls() -> None:
    check = check_of(grid(L_SHAPE, ONE))
    wrong = check.explain(seen(L_SHAPE, PLACES[0], Pose2(), 0.0), Pose2(6.0, 1.5, 2.0))
    assert wrong.fitness < 0.8
    assert wrong.through > 0.05


def test_beams_that_end_where_nothing_is_mapped_are_counted_apart() -> None:
    occupancy = grid(L_SHAPE, ONE)
    cells = occupancy.cells.copy()
    cells[:, cells.shape[1] // 3 :] = -1
    check = check_of(replace(occupancy, cells=cells))
    place = Pose2(2.5, 1.5, 0.0)
    found = check.explain(seen(L_SHAPE, place, Pose2(), 0.0), place)
    assert found.unmapped > 0.1
    assert found.fitness > 0.85


def test_a_scan_without_points_explains_nothing() -> None:
    check = check_of(grid(L_SHAPE, ONE))
    empty = seen(L_SHAPE, PLACES[0], Pose2(), 0.0)
    none = replace(empty, scan=replace(empty.scan, ranges=np.full(180, np.inf, dtype=np.float32)))
    assert check.explain(none, PLACES[0]).fitness == 0.0
