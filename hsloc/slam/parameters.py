"""Parameters of the graph mapper, composed of those of its parts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from hsloc.parameters import Count, Parameters
from hsloc.slam.front_end_parameters import FrontEndParameters
from hsloc.slam.joint_registration import JointRegistrationParameters
from hsloc.slam.loop_matcher import LoopParameters
from hsloc.slam.occupancy_mapper import OccupancyMapperParameters

if TYPE_CHECKING:
    from hsloc.localisation.relocaliser import RelocaliserParameters
    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.matching.match import Matcher
    from hsloc.model.pose2 import Pose2
    from hsloc.slam.map_state import MapState


@dataclass(frozen=True, slots=True, kw_only=True)
class GraphMapperParameters(Parameters):
    """Parameters of the graph mapper; one default for all logs."""

    front_end: FrontEndParameters = field(default_factory=FrontEndParameters)
    loops: LoopParameters = field(default_factory=LoopParameters)
    joint_registration: JointRegistrationParameters = field(default_factory=JointRegistrationParameters)
    occupancy: OccupancyMapperParameters = field(default_factory=OccupancyMapperParameters)
    use_odometry: bool = True
    """Whether odometry predicts each scan's pose; otherwise a constant velocity does."""
    solve_after: Count = 5000
    """Number of keyscans after which the map is solved while the log is read, so that scans which it explains are
    localised on it and add nothing to it; it is solved again when the log has left it and as many scans have come as
    it has keyscans."""
    passes: Count = 3
    """Maximum number of passes of loop search and joint registration over the whole log."""


@dataclass(frozen=True, slots=True)
class Resume:
    """A saved map to go on from, what searches it, and where in it the log begins, if that is known.

    `field` is the likelihood field of the map; `matcher` and `relocaliser` find the log's place on it.
    """

    state: MapState
    field: LikelihoodField
    matcher: Matcher
    relocaliser: RelocaliserParameters
    T_map_first: Pose2 | None = None
