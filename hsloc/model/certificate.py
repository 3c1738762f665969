"""What was proven about the pose of a scan."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hsloc.model.pose2 import Pose2


@dataclass(frozen=True, slots=True)
class Certificate:
    """Proven statements about a match, all of them about the window that was searched and the field as it is.

    `gap`: no pose of the window is fitter than the match by more. `rival_bound`: no pose of the window that is farther
    from the match than the radius, or turned by more than the angle, is fitter than this; `rival` is the fittest such
    pose that was found, None where none came within the margin. `boxes` is the work: the boxes that were bounded.
    `is_optimal`: the gap is within epsilon. `is_distinct`: every other place is worse by the margin. `gain` is how much
    fitter the pose is that the proof came upon than the one it was given; 0 where it came upon none.
    """

    gap: float
    rival_bound: float
    rival: Pose2 | None
    boxes: int
    is_optimal: bool
    is_distinct: bool
    gain: float
