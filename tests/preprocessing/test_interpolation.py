"""How wrong interpolated odometry is, by the odometry itself; and which poses of a log are interpolated."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from hsloc.model import Odometry, PairedScan, Pose2, Scan, wrap_angles
from hsloc.preprocessing.interpolation import Interpolations
from hsloc.preprocessing.scans import pair

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.model import Event


def walk(seconds: float, hertz: float, seed: int) -> list[Odometry]:
    """A robot that drives at 0.5 m/s, with a rate of turn that changes at random: by 0.5 rad/s in a second."""
    rng, n = np.random.default_rng(seed), round(seconds * hertz)
    rate = np.zeros(n)
    for k in range(1, n):  # it comes back to none within 4 s
        rate[k] = rate[k - 1] * (1.0 - 0.25 / hertz) + rng.normal(0.0, 0.5 / np.sqrt(hertz))
    heading = wrap_angles(np.cumsum(rate) / hertz)
    x, y = (np.cumsum(0.5 / hertz * each(heading)) for each in (np.cos, np.sin))
    return [Odometry(round(1e9 * k / hertz), Pose2(x[k], y[k], heading[k])) for k in range(n)]


def errors(events: list[Odometry], hertz: float, gap_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Errors of headings in the middle of gaps, and their standard deviations as the messages before say."""
    found, size = Interpolations(), round(gap_s * hertz)
    off, sigma = [], []
    for k in range(0, len(events) - size, size):
        before, after, between = events[k], events[k + size], events[k + size // 2]
        interpolation = found.between(before, after)
        assert interpolation is not None
        middle = before.T_odom_base.interpolate(after.T_odom_base, 0.5)
        off.append(middle.between(between.T_odom_base).theta)
        sigma.append(np.sqrt(interpolation.variances(between.stamp_ns)[2]))
        for event in events[k : k + size]:
            found.follow(event)
    return np.array(off[20:]), np.array(sigma[20:])


@pytest.mark.parametrize(("hertz", "gap_s"), [(20.0, 0.4), (20.0, 1.6), (10.0, 0.2)])
def test_errors_are_as_large_as_stated(hertz: float, gap_s: float) -> None:
    off, sigma = errors(walk(240.0, hertz, 5), hertz, gap_s)
    assert 0.6 < np.mean((off / sigma) ** 2) < 1.7
    assert np.mean(np.abs(off) < 2.5 * sigma) > 0.95


def test_messages_that_are_near_are_as_good_as_their_poses() -> None:
    found = Interpolations()
    assert found.between(Odometry(0, Pose2()), Odometry(100_000_000, Pose2(0.1, 0.0, 0.3))) is None
    slow = found.between(Odometry(0, Pose2()), Odometry(400_000_000, Pose2(0.1, 0.0, 0.3)))
    assert slow is not None
    assert not slow.variances(0).any()
    # Before anything is known accelerations are those of ordinary robots.
    assert np.sqrt(slow.variances(200_000_000)) == pytest.approx(np.array((1.0, 1.0, 2.0)) * 0.4**2 / 8.0)
    # After a minute without messages nothing is known, but the window stays one that can be searched.
    gone = found.between(Odometry(0, Pose2()), Odometry(60_000_000_000, Pose2(9.0, 0.0, 0.3)))
    assert gone is not None
    assert np.sqrt((gone.way, gone.turn)) == pytest.approx((0.5, 0.35))


def test_a_scan_in_a_gap_is_paired_with_how_sure_its_pose_is() -> None:
    scans = [Scan(stamp, np.ones(8, dtype=np.float32), 0.0, 0.1, 0.1, 10.0) for stamp in (0, 20_000_000, 300_000_000)]
    messages = [Odometry(stamp, Pose2(stamp * 1e-9, 0.0, 0.0)) for stamp in (0, 40_000_000, 640_000_000)]
    events: list[Event] = sorted([*messages, *scans], key=lambda event: event.stamp_ns)
    paired = [event.interpolation for event in pair(events) if isinstance(event, PairedScan)]
    assert paired[:2] == [None, None]
    assert paired[2] is not None
    assert (paired[2].before_ns, paired[2].after_ns) == (40_000_000, 640_000_000)
