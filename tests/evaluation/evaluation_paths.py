"""Paths for the tests of hsloc.evaluation."""

from __future__ import annotations

import numpy as np

from hsloc.model import Trajectory, wrap_angles

START_NS = 1_700_000_000_123_456_789


def make_path(rng, n, *, period_ns=20_000_000, start_ns=START_NS, step=0.05, jitter_ns=0):
    """A wandering robot: n poses, a smooth path with turns through +-pi."""
    turns = np.cumsum(rng.normal(0.0, 0.02, n)) * 0.3
    theta = rng.uniform(-3.0, 3.0) + np.cumsum(turns)
    steps = np.abs(rng.normal(step, 0.3 * step, n))
    xy = np.cumsum(np.column_stack((steps * np.cos(theta), steps * np.sin(theta))), axis=0)
    stamps = start_ns + period_ns * np.arange(n, dtype=np.int64)
    if jitter_ns:
        stamps = stamps + rng.integers(-jitter_ns, jitter_ns, n)
    return Trajectory(stamps, np.column_stack((xy + rng.uniform(-5, 5, 2), wrap_angles(theta))))


def disturb(rng, path, *, sigma=0.03, sigma_theta=0.01, every=1, shift_ns=0):
    """The same path with noise, seen every so many poses and a little later."""
    poses = path.poses[::every].copy()
    poses[:, :2] += rng.normal(0.0, sigma, (len(poses), 2))
    poses[:, 2] = wrap_angles(poses[:, 2] + rng.normal(0.0, sigma_theta, len(poses)))
    return Trajectory(path.stamps_ns[::every] + shift_ns, poses)
