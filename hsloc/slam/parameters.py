"""Parameters of the graph mapper, composed of those of its parts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from hsloc.slam.front_end import LocalMatchingParameters
from hsloc.slam.joint_registration import RefinementParameters
from hsloc.slam.loop_closer import LoopParameters
from hsloc.slam.occupancy_mapper import DrawingParameters

if TYPE_CHECKING:
    from hsloc.model.pose2 import Pose2
    from hsloc.slam.map_state import MapState


@dataclass(frozen=True, slots=True, kw_only=True)
class GraphMapperParameters:
    """All of the graph mapper's, one default for all logs."""

    local_matching: LocalMatchingParameters = field(default_factory=LocalMatchingParameters)
    loops: LoopParameters = field(default_factory=LoopParameters)
    refinement: RefinementParameters = field(default_factory=RefinementParameters)
    drawing: DrawingParameters = field(default_factory=DrawingParameters)
    use_odometry: bool = True
    """Otherwise a constant velocity predicts, and the log's odometry is not looked at."""
    passes: int = 3
    """The whole log is gone over again at most so often, until nothing moves."""


@dataclass(frozen=True, slots=True)
class Resume:
    """A saved map to go on from, and where in it the log begins, if that is known."""

    state: MapState
    T_map_first: Pose2 | None = None
