"""Slips along bare walls, which only a wall across the corridor shows."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from room_scans import room_scan

from hsloc.model.pose2 import Pose2, relative_poses
from hsloc.slam.displaced import mended
from hsloc.slam.keyscans import KeyScan, KeyScans
from hsloc.slam.map_session import MapSession
from hsloc.slam.pose_graph import Edges
from hsloc.slam.submaps import Submaps

if TYPE_CHECKING:
    from numpy.typing import NDArray

SLIP_AT = 17
"""The keyscan before the step."""


def session(slip: float, *, sees_the_ends: bool = True) -> tuple[MapSession, NDArray[np.float64]]:
    """A drive along a room of 6 m whose front end missed `slip` metres in one step, and the true poses."""
    true = np.array([(1.0 + 0.1 * k, 2.0, 0.0) for k in range(36)])
    kept = []
    for k, pose in enumerate(true):
        place = Pose2.from_array(pose)
        scan = room_scan(place, beams=271, noise=0.01, seed=k)
        bare = np.abs((place @ scan.points_base())[:, 1] - 2.0) > 1.9
        ranges = scan.ranges if sees_the_ends else np.where(bare, scan.ranges, np.nan).astype(np.float32)
        kept.append(KeyScan.of(replace(scan, ranges=ranges)))
    found = true - np.outer(np.arange(36) > SLIP_AT, (slip, 0.0, 0.0))
    motions = np.concatenate((np.zeros((1, 3)), relative_poses(found[:-1], found[1:])))
    covariances = np.broadcast_to(np.diag((0.01**2, 0.01**2, 0.002**2)), (36, 3, 3)).copy()
    refused = np.zeros(36, dtype=bool)
    places = Submaps.split_by_path_length(found, motions, covariances, 1.0, 0.3)
    steps = Edges.chain(motions[1:], covariances[1:])
    scans = KeyScans.from_scans(kept)
    return MapSession(scans, np.arange(36), found, motions, covariances, refused, steps, places), true


@pytest.mark.parametrize("slip", [0.4, -0.7])
def test_a_slip_along_bare_walls_is_measured_again_by_those_across(slip: float) -> None:
    log, true = session(slip)
    found = mended(log, log.scans.arrays(90))
    np.testing.assert_allclose(found.poses[:, :2], true[:, :2], atol=0.03)
    np.testing.assert_allclose(found.motions[1:], relative_poses(true[:-1], true[1:]), atol=0.03)
    np.testing.assert_array_equal(found.places.poses, found.poses)
    assert SLIP_AT in found.slips
    assert found.slipped.sum() <= 20
    # Along the walls a step that may have slipped is less certain than the others, across them it is not.
    spread = found.covariances[1:] - log.covariances[1:]
    assert (spread[found.slipped, 0, 0] > 0.04**2).all()
    assert np.abs(spread[found.slipped, 1, 1]).max() < 0.02**2
    assert not spread[~found.slipped].any()


@pytest.mark.parametrize(("slip", "sees_the_ends"), [(0.0, True), (0.1, True), (0.4, False)])
def test_nothing_is_changed_that_the_scans_do_not_deny(slip: float, sees_the_ends: bool) -> None:
    log, _ = session(slip, sees_the_ends=sees_the_ends)
    assert mended(log, log.scans.arrays(90)) is log
