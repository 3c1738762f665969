"""Join saved maps of one building, found by a search of the whole map and by loops between them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.config import Config
from hsloc.errors import MapError
from hsloc.model.pose2 import Pose2
from hsloc.replay.map_and_start import read_saved_map, resumed
from hsloc.slam.back_end import finish_session
from hsloc.slam.map_extension import connect
from hsloc.slam.map_session import from_map_state
from hsloc.slam.trajectory_correction import EventLog

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from hsloc.slam.map_state import MapState
    from hsloc.slam.result import MappingResult


@dataclass(frozen=True, slots=True, eq=False)
class MapMerge:
    """Maps that were joined, in the frame of the first.

    `T_first_map` are the poses of the frames of all maps, `joints` the numbers of loops that join each with those
    before it (0 for the first).
    """

    names: tuple[str, ...]
    T_first_map: tuple[Pose2, ...]
    joints: tuple[int, ...]
    mapping: MappingResult


def merge_maps(paths: Sequence[Path], seed: int = 0, progress: Callable[[float], None] | None = None) -> MapMerge:
    """Join the maps of mapping runs, folders or their map.npz, at least two.

    Each map is searched for in those that are joined already. Raises MapError, with the reason, for a path without
    a map, and where no place of one is recognised in the others.
    """
    if len(paths) < 2:
        raise MapError("a single map has nothing to be merged with; name two or more")
    states = [read_saved_map(path) for path in paths]
    merged, placed, joints = states[0], [Pose2(0.0, 0.0, 0.0)], [0]
    result: MappingResult | None = None
    for k, state in enumerate(states[1:], 1):
        report = _part(progress, k - 1, len(states) - 1)
        result = _joined(merged, state, seed, report)
        before = len(merged.poses)
        first = Pose2.from_array(result.keyscan_poses[before])
        placed.append(first @ Pose2.from_array(state.poses[0]).inverse())
        ends = zip(result.loops, result.loop_ends().tolist(), strict=True)
        joints.append(sum(loop.accepted and a < before <= b for loop, (a, b) in ends))
        assert result.state is not None
        merged = replace(result.state, name=f"{merged.name} and {state.name}")
    assert result is not None
    return MapMerge(tuple(str(path) for path in paths), tuple(placed), tuple(joints), result)


def _joined(old: MapState, new: MapState, seed: int, report: Callable[[float], None]) -> MappingResult:
    config, rng = Config(), np.random.default_rng(seed)
    # The steps of a saved map are mended already, and its odometry was held against it.
    parameters = replace(config.graph_mapper, use_odometry=False)
    resume = resumed(old, config, config.make_matcher())
    track = EventLog(parameters.front_end.turn_length)
    try:
        session = connect(resume, from_map_state(new, parameters), parameters, rng)
        return finish_session(session, track, parameters, rng, report, old)
    except MapError as error:
        raise MapError(
            f"{new.name}: no place of it was recognised for certain in {old.name}, so the maps are not merged; they "
            "must overlap by two places of some metres that look like no other"
        ) from error


def _part(progress: Callable[[float], None] | None, k: int, count: int) -> Callable[[float], None]:
    return lambda part: progress((k + part) / count) if progress is not None else None
