"""Matches of a robot whose laser is not where it is stated to be."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.localisation.kalman_filter import Anchor
from hsloc.model.pose2 import IDENTITY, Pose2

if TYPE_CHECKING:
    from collections.abc import Callable


def drive(wrong_by: Pose2 | Callable[[int], Pose2], seed: int, left: float = 0.5, turned: float = 0.0) -> list[Anchor]:
    """200 matches 0.2 m apart, each with 5 mm and 2 mrad of noise; the odometry has 1 % of scale and noise, too.

    The laser is `wrong_by`, which may be one of the number of the match, from where it is stated. `turned` is the
    standard deviation of turns that the odometry reports before each step (rad), and there are none.
    """
    rng, other = np.random.default_rng(seed), np.random.default_rng(seed + 100)
    pose, odometry, anchors = Pose2(3.0, 4.0, 1.0), IDENTITY, []
    for k in range(200):
        turn = 0.2 if rng.random() < left else -0.2
        turn *= float(k % 3 != 0)
        noise = rng.normal(0.0, 1.0, 6) * (0.005, 0.005, 0.002, 0.004, 0.0, 0.004)
        seen = (pose @ (wrong_by(k) if callable(wrong_by) else wrong_by)).to_array() + noise[:3]
        anchors.append(Anchor(k, odometry, Pose2.from_array(seen), np.eye(3), begins=k == 0))
        pose = pose @ Pose2(0.2, 0.0, turn)
        odometry = (
            odometry
            @ Pose2(0.0, 0.0, float(other.normal(0.0, turned)))
            @ Pose2(0.202 + float(noise[3]), 0.0, turn + float(noise[5]))
        )
    return anchors
