"""The motion gate: a scan is matched after the robot has moved ([P] V; AMCL's update_min_d and update_min_a)."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hsloc.model.pose2 import Pose2


@dataclass(frozen=True, slots=True)
class MotionGate:
    """Open where a motion is long enough or turns far enough."""

    min_distance: float
    """Least translation that opens the gate [m], 0 or more."""
    min_angle: float
    """Least rotation that opens the gate [rad], 0 or more."""

    def is_open(self, motion: Pose2) -> bool:
        """Whether a motion since the last scan that was used reaches one of the limits."""
        return hypot(motion.x, motion.y) >= self.min_distance or abs(motion.theta) >= self.min_angle
