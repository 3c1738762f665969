"""Which scans are compared with which."""

from __future__ import annotations

import numpy as np
import pytest

from hsloc.model.pose2 import wrap_angles
from hsloc.slam.joint_registration import neighbour_pairs

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
