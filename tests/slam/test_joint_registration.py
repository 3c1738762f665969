"""Which scans are compared with which."""

from __future__ import annotations

import numpy as np
import pytest
from room_scans import room_scan

from hsloc.errors import ConfigError
from hsloc.model.pose2 import Pose2, wrap_angles
from hsloc.slam.joint_registration import JointRegistrationParameters, neighbour_pairs, refine
from hsloc.slam.keyscans import KeyScan, KeyScans
from hsloc.slam.pose_graph import Edges

RADIUS, MOST, TEMPORAL = 3.0, 8, 3


def sort_of(pose: np.ndarray) -> tuple[int, int, int]:
    x, y = np.floor(pose[:2] / (0.5 * RADIUS)).astype(int).tolist()
    return x, y, int(np.floor(pose[2] / (2.0 * np.pi) * 8)) % 8


def naive_pairs(poses: np.ndarray, partners: list[int]) -> set[tuple[int, int]]:
    """Each scan with those just before it, and with the nearest partner of each of the nearest sorts."""
    n = len(poses)
    found = {(k, k + gap) for gap in range(1, TEMPORAL + 1) for k in range(n - gap)}
    for k in range(n):
        near = []
        for j in partners:
            away = np.hypot(*(poses[j, :2] - poses[k, :2]))
            if j != k and away <= RADIUS:
                near.append((away + 0.5 * abs(float(wrap_angles(poses[j, 2] - poses[k, 2]))), j))
        seen: set[tuple[int, int, int]] = set()
        for _, j in sorted(near):
            if len(seen) == MOST:
                break
            if sort_of(poses[j]) not in seen:
                seen.add(sort_of(poses[j]))
                found.add((min(j, k), max(j, k)))
    return found


def drive(n: int, side: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack((rng.uniform(0, side, (n, 2)), rng.uniform(-np.pi, np.pi, n)))


def as_set(pairs: np.ndarray) -> set[tuple[int, int]]:
    return {(int(i), int(j)) for i, j in pairs}


@pytest.mark.parametrize("n", [1, 2, 7, 600])
def test_pairs_are_those_of_the_plain_rule(n: int) -> None:
    poses = drive(n, 12.0)
    assert as_set(neighbour_pairs(poses, RADIUS, MOST, TEMPORAL, 10**6)) == naive_pairs(poses, list(range(n)))


def test_of_a_crowd_some_stand_for_all_and_everybody_has_partners() -> None:
    crowd = 5
    poses = drive(600, 2.5)
    pairs = neighbour_pairs(poses, RADIUS, MOST, 0, crowd)
    members: dict[tuple[int, int, int], list[int]] = {}
    for k, pose in enumerate(poses):
        members.setdefault(sort_of(pose), []).append(k)
    assert max(map(len, members.values())) > 4 * crowd
    partners = sorted(
        numbers[rank]
        for numbers in members.values()
        for rank in range(len(numbers))
        if len(numbers) <= crowd or (rank + 1) * crowd // len(numbers) > rank * crowd // len(numbers)
    )
    assert all(sum(k in partners for k in numbers) == min(crowd, len(numbers)) for numbers in members.values())
    chain = {(k, k + gap) for gap in range(1, TEMPORAL + 1) for k in range(len(poses) - gap)}
    assert as_set(pairs) | chain == naive_pairs(poses, partners)
    assert set(np.unique(pairs).tolist()) == set(range(len(poses)))


def test_a_pass_uses_what_the_one_before_found_of_scans_that_did_not_move() -> None:
    true = [Pose2(1.0 + 0.3 * k, 1.5, 0.1 * k) for k in range(10)]
    scans = KeyScans.from_scans([KeyScan.of(room_scan(pose, noise=0.01, seed=k)) for k, pose in enumerate(true)])
    poses = np.array([pose.to_array() for pose in true])
    start = poses + np.random.default_rng(3).normal(0.0, (0.03, 0.03, 0.01), poses.shape)
    start[0] = poses[0]
    parameters = JointRegistrationParameters(rounds=6, temporal=9)
    arrays = scans.arrays(parameters.points_per_scan)
    first = refine(start, arrays, Edges.none(), parameters)
    np.testing.assert_allclose(first.poses[:, :2], poses[:, :2], atol=0.02)
    at = first.evaluated.at.copy()
    later = JointRegistrationParameters(gates=parameters.gates[-1:], temporal=9)
    again = refine(first.poses, arrays, Edges.none(), later, previous=first)
    afresh = refine(first.poses, arrays, Edges.none(), later)
    np.testing.assert_array_equal(again.evaluated.at, at)
    np.testing.assert_array_equal(again.counts, first.counts)
    np.testing.assert_allclose(again.poses, afresh.poses, atol=3e-4)
    moved = first.poses.copy()
    moved[4, 0] += 0.02
    changed = refine(moved, arrays, Edges.none(), later, previous=first)
    touches = (first.pairs == 4).any(axis=1)
    assert (changed.evaluated.at[touches] != at[touches]).any(axis=1).all()
    np.testing.assert_allclose(changed.poses, afresh.poses, atol=3e-3)


def test_a_crowd_of_nobody_is_refused() -> None:
    with pytest.raises(ConfigError, match="max_scans_per_view is 0; it must be from 1"):
        JointRegistrationParameters(max_scans_per_view=0)
