"""Odometry from scans alone, and with headings that predict rotations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.model import Heading, Odometry, Scan, Truth
from hsloc.simulation.scenario import Scenario
from hsloc.simulation.simulator import events
from hsloc.simulation.world_files import load_world
from hsloc.slam.front_end_parameters import FrontEndParameters
from hsloc.slam.laser_odometry import with_laser_odometry

if TYPE_CHECKING:
    from collections.abc import Iterator

    from hsloc.model import Event


def test_headings_predict_the_rotations_between_rare_scans() -> None:
    truth: dict[int, float] = {}

    def headings() -> Iterator[Event]:
        """Scans with the headings of a gyroscope that is 1 % and 0.01 rad/s off, in place of the odometry."""
        drift = 0.0
        for event in events(Scenario("office", seed=5, duration_s=36.0, scan_rate_hz=1.0), load_world("office")):
            if isinstance(event, Scan):
                yield event
            elif isinstance(event, Truth):
                truth[event.stamp_ns] = event.T_map_base.theta
                drift += 0.0002
                yield Heading(event.stamp_ns, 1.01 * event.T_map_base.theta + drift)

    found = with_laser_odometry(headings(), FrontEndParameters(), np.random.default_rng(0))
    poses = [event for event in found if isinstance(event, Odometry)]
    turned = np.unwrap([pose.T_odom_base.theta for pose in poses])
    true = np.unwrap([truth[pose.stamp_ns] for pose in poses])
    assert np.abs((turned - turned[0]) - (true - true[0])).max() < 0.02
    assert np.ptp(np.diff(true)) > 0.8  # more than the scans alone are searched for
