"""Where the robot has been, scans are localised on the map and add nothing to it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from drives import ape_rmse, drive

from hsloc.model import PairedScan, Pose2, Status
from hsloc.slam.back_end import verified_stretches
from hsloc.slam.keyscans import KeyScan, KeyScans
from hsloc.slam.known_map import KnownMap
from hsloc.slam.map_session import Tie
from hsloc.slam.mapper import Mapper
from hsloc.slam.parameters import GraphMapperParameters

if TYPE_CHECKING:
    from hsloc.model import Odometry, Trajectory

    Events = list[Odometry | PairedScan]

_LAP_S = 106.0
"""A little less than a lap of the office takes."""


@pytest.fixture(scope="module")
def laps() -> tuple[Events, Trajectory]:
    """A lap of the office, and a fifth of the next."""
    return drive("office", seed=4, laps=2.0, duration_s=135.0)


def seconds(event: Any, events: Events) -> float:
    """Since the first event."""

    def stamp(one: Any) -> int:
        return int(one.scan.stamp_ns if isinstance(one, PairedScan) else one.stamp_ns)

    return (stamp(event) - stamp(events[0])) * 1e-9


def test_a_lap_in_a_known_building_adds_nothing(laps: tuple[Events, Trajectory]) -> None:
    """The map is solved after 480 keyscans, and again as it is left; at both times the path leaves it with a gap."""
    events, truth = laps
    mapper = Mapper(GraphMapperParameters(solve_after=480), np.random.default_rng(0))
    estimates = [mapper.update(event) for event in events]
    result = mapper.finish()
    quality = result.quality
    assert quality.followed > 100
    assert quality.keyscans < 1050, "one lap"
    assert ape_rmse(events, result.scan_poses, truth) < 0.01
    assert result.evidence.verdict == "good"
    assert [loop.reason for loop in result.loops if loop.accepted and loop.reason] == ["left the known map"] * 2
    scans = [
        (event, estimate) for event, estimate in zip(events, estimates, strict=True) if isinstance(event, PairedScan)
    ]
    lap = [estimate for event, estimate in scans if seconds(event, events) > _LAP_S + 5.0]
    assert sum(estimate.status is Status.MATCHED for estimate in lap) > 0.4 * len(lap), "every second one"
    matched = [estimate.covariance for estimate in lap if estimate.status is Status.MATCHED]
    sigmas = [np.sqrt(np.trace(covariance[:2, :2])) for covariance in matched if covariance is not None]
    assert np.median(sigmas) < 0.03, "on the known map errors do not add up"
    assert (np.linalg.eigvalsh(result.scan_covariances).min(axis=1) > -1e-12).all()
    late = np.sqrt(np.trace(result.scan_covariances[-200:, :2, :2], axis1=1, axis2=2))
    assert late.min() > 0.001, "an anchored scan is less certain than its keyscan"
    assert late.max() < 0.03


def test_a_known_map_has_the_places_where_it_is_known() -> None:
    angles = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    ranges = (3.0 / np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))).astype(np.float32)
    points = (ranges[:, None] * np.column_stack((np.cos(angles), np.sin(angles)))).astype(np.float32)
    geometry = np.array((0.0, 0.0, 0.0, -np.pi, 2.0 * np.pi / 360.0))
    scan = KeyScan.fitted(points, np.arange(360, dtype=np.int32), ranges, geometry)
    poses = np.array(((0.0, 0.0, 0.0), (0.02, 0.0, 0.0), (0.7, 0.0, 0.0)))
    known = KnownMap(KeyScans.from_scans([scan] * 3), poses, 30.0)
    assert known.near(Pose2(0.1, 0.0, 0.0), 5) == [0, 2], "one for each square and heading"
    assert known.near(Pose2(0.1, 0.0, np.pi), 5) == [], "no view in this direction"
    assert known.near(Pose2(9.0, 0.0, 0.0), 5) == []
    assert known.explained(points.astype(np.float64)) == 1.0
    assert known.explained(points.astype(np.float64) + 20.0) == 0.0


def test_loops_verify_the_path_on_both_sides_of_a_gap() -> None:
    """Keyscan 50 was made after the robot had been followed on the map to keyscan 20."""
    tie = Tie(20, 50, Pose2(), np.eye(3))
    assert verified_stretches(np.array([(3, 40)]), (tie,)).tolist() == [[3, 40]]
    assert verified_stretches(np.array([(3, 60)]), (tie,)).tolist() == [[50, 60], [3, 20]]
    assert verified_stretches(np.array([(55, 60)]), (tie,)).tolist() == [[55, 60]]
    assert verified_stretches(np.zeros((0, 2), dtype=np.int64), ()).shape == (0, 2)
