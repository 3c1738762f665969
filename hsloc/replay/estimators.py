"""The localiser or the mapper of a run, and the events it gets, as the request asks for."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.config import preset
from hsloc.errors import ConfigError
from hsloc.matching.window import Window
from hsloc.model.events import Heading, Odometry
from hsloc.model.pose2 import IDENTITY
from hsloc.preprocessing.left_out_hits import without_isolated
from hsloc.preprocessing.odometry import OdometryWatch
from hsloc.replay.map_and_start import load_grid, resumed
from hsloc.slam.laser_odometry import with_laser_odometry
from hsloc.slam.point_mapper import PointMapper
from hsloc.slam.stated_loops import StatedLoops

if TYPE_CHECKING:
    from collections.abc import Iterable

    from hsloc.localisation.localiser import Localiser
    from hsloc.matching.likelihood_field import LikelihoodField
    from hsloc.matching.match import Matcher
    from hsloc.model.events import Event
    from hsloc.model.occupancy_grid import OccupancyGrid
    from hsloc.model.pose2 import Pose2
    from hsloc.request import RunRequest
    from hsloc.slam.map_state import MapState
    from hsloc.slam.mapper import Mapper


def events_of(request: RunRequest, recorded: Iterable[Event], lidar_only: bool, localise: bool) -> Iterable[Event]:
    """Recorded events; their odometry watched, or left out, or replaced for a localiser by that of the scans.

    Headings stay, unless the scans alone are asked for.
    """
    if not lidar_only:
        # The point mapper cannot do without odometry, whatever that is like.
        events = recorded if request.config.mapper == "point" and not localise else OdometryWatch(recorded)
        return events if localise else without_isolated(events)
    unused = (Odometry, Heading) if request.no_odometry else (Odometry,)
    events = (event for event in recorded if not isinstance(event, unused))
    if localise:
        rng = np.random.default_rng((request.seed, 1))
        return with_laser_odometry(events, request.config.graph_mapper.front_end, rng)
    return without_isolated(events)


def make_mapper(request: RunRequest, state: MapState | None, lidar_only: bool) -> Mapper | PointMapper:
    """The mapper that the run asks for; `state` is the saved map that it extends.

    Raises ConfigError for options that it would not use, and MapError for a plan that cannot be read.
    """
    _require_matcher(request)
    if request.config.mapper == "point":
        if lidar_only:
            raise ConfigError("the point mapper predicts with odometry; leave out --no-odom, or use --mapper graph")
        start = IDENTITY if request.initial_pose is None else request.initial_pose
        return PointMapper(request.matcher, request.config.point_mapper, np.random.default_rng(request.seed), start)
    resume = None
    if state is not None:
        begin = None if request.unknown_start else request.initial_pose
        resume = resumed(state, request.config, request.matcher, begin)
    from hsloc.slam.mapper import Mapper

    return Mapper(
        replace(request.config.graph_mapper, use_odometry=not lidar_only),
        np.random.default_rng(request.seed),
        resume,
        StatedLoops.parsed(request.assert_loop, request.forbid_loop),
        None if request.align_to is None else load_grid(request.align_to)[0],
    )


def make_localiser(
    request: RunRequest, grid: OccupancyGrid, likelihood: LikelihoodField, start: Pose2 | None
) -> Localiser:
    """The localiser on a map, with its kernels compiled; `start` is T_map_base at the first event, if it is known."""
    from hsloc.localisation.localiser import Localiser

    rng = np.random.default_rng(request.seed)
    _warm_up(request.matcher, likelihood)
    return Localiser.from_parameters(grid, likelihood, request.matcher, request.config.localiser, rng, start)


def _require_matcher(request: RunRequest) -> None:
    """Raise ConfigError for a matcher that was asked for and that the graph mapper would not use."""
    if request.config.mapper == "graph" and request.matcher_name != preset(request.preset).matcher:
        raise ConfigError(
            f"the graph mapper has a matcher of its own and would not use {request.matcher_name}; leave out --matcher, "
            "or use --mapper point"
        )


def _warm_up(matcher: Matcher, likelihood: LikelihoodField) -> None:
    """Have the kernels compiled (once after an installation, up to a minute) before the clock of the replay starts."""
    points = np.zeros((1, 2))
    window = Window(likelihood.T_map_field, 0.1, 0.1, 0.1)
    matcher.match(points, likelihood, window, np.random.default_rng(0))
