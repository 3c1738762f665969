"""Simulated drives for the tests of mapping."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from hsloc.model import Odometry, PairedScan, Trajectory, Truth
from hsloc.preprocessing.scans import pair
from hsloc.simulation.presets import preset
from hsloc.simulation.simulator import events
from hsloc.simulation.world_files import load_world

if TYPE_CHECKING:
    from numpy.typing import NDArray


def drive(scenario: str, **changes: Any) -> tuple[list[Odometry | PairedScan], Trajectory]:
    """Events of a drive as the mapper gets them, and the truth."""
    setting = replace(preset(scenario), **changes)
    recorded = list(pair(events(setting, load_world(setting.world, None))))
    truth = Trajectory.from_pairs(
        [(event.stamp_ns, event.T_map_base) for event in recorded if isinstance(event, Truth)]
    )
    return [event for event in recorded if not isinstance(event, Truth)], truth


def ape_rmse(events: list[Odometry | PairedScan], poses: NDArray[np.float64], truth: Trajectory) -> float:
    """RMSE (m) of the poses at the scans, after rotation and translation."""
    stamps = np.array([event.scan.stamp_ns for event in events if isinstance(event, PairedScan)])
    known = (stamps >= truth.stamps_ns[0]) & (stamps <= truth.stamps_ns[-1])
    ours, theirs = poses[known, :2], truth.interpolated(stamps[known])[:, :2]
    a, b = ours - ours.mean(axis=0), theirs - theirs.mean(axis=0)
    h = a.T @ b
    theta = np.arctan2(h[0, 1] - h[1, 0], h[0, 0] + h[1, 1])
    c, s = np.cos(theta), np.sin(theta)
    return float(np.sqrt(((a @ np.array(((c, s), (-s, c))) - b) ** 2).sum(axis=1).mean()))
