"""Where in a saved map a further log was driven: its first place is searched for on the whole map."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.errors import MapError
from hsloc.localisation.relocaliser import Relocaliser
from hsloc.model.events import PairedScan
from hsloc.model.pose2 import Pose2
from hsloc.slam.loop_closer import LoopCloser
from hsloc.slam.map_session import concatenate, from_map_state

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.slam.keyscans import KeyScans
    from hsloc.slam.loop_matcher import Loop
    from hsloc.slam.map_session import MapSession
    from hsloc.slam.map_state import MapState
    from hsloc.slam.parameters import GraphMapperParameters, Resume

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]

_ATTEMPTS = 10
"""Places of the log, evenly chosen, from which the map is searched: it may begin outside of what was drawn."""
LOOKED = 60
"""Keyscans looked at from each of them, at most."""
AROUND = 2
"""Places compared before and after the one that was found."""
_AGREE = 2
"""Minimum number of places that a loop connects, where the log has that many."""


def connect(resume: Resume, log: MapSession, parameters: GraphMapperParameters, rng: Generator) -> MapSession:
    """The saved map and the log in its frame, connected by loops.

    A place that is found is believed if loops between it and the old places around it pass all that is asked of a
    loop. Raises MapError if there is none.
    """
    old = from_map_state(resume.state, parameters)
    start = resume.T_map_first
    found = _relocalised(resume, log, parameters, rng) if start is None else iter([(start, 0)])
    for T_map_front, scan in found:
        both = concatenate(old, log.moved(T_map_front))
        loops = _verified(both, both.first + scan, parameters, rng)
        if loops:
            return replace(both, known=(*both.known, *loops))
    raise MapError(unconnected(resume.state))


def unconnected(state: MapState) -> str:
    """For whom no connection was found."""
    return (
        f"{state.name}: no place of the log was recognised in this map, so it is not extended; "
        "give --initial-pose, or a log that begins or passes where the map is known"
    )


def _relocalised(
    resume: Resume, log: MapSession, parameters: GraphMapperParameters, rng: Generator
) -> Iterator[tuple[Pose2, int]]:
    """T_map_front by the relocaliser, and the keyscan of the log at which it was sure."""
    noise = parameters.front_end.odometry_noise
    relocaliser = Relocaliser(resume.state.grid, resume.field, resume.matcher, resume.relocaliser, noise, rng)
    starts = log.places.start[:-1]
    begins = starts[np.unique(np.linspace(0, len(starts) - 1, _ATTEMPTS).astype(np.int64))]
    return places_on_map(
        log.scans, log.poses, [range(k, min(k + LOOKED, len(log.poses))) for k in begins.tolist()], relocaliser
    )


def places_on_map(
    scans: KeyScans, poses: F64, tried: list[range], relocaliser: Relocaliser
) -> Iterator[tuple[Pose2, int]]:
    """T_map_front, for each run of keyscans that is `tried`, and the keyscan at which the relocaliser was sure.

    `poses` (n, 3) are those of the keyscans in their own frame.
    """
    for run in tried:
        relocaliser.start()
        for scan in run:
            T_front_base = Pose2.from_array(poses[scan])
            verdict = relocaliser.update(PairedScan(scans.scan(scan), T_front_base), 0)
            if verdict.is_sure and verdict.pose is not None:
                yield verdict.pose @ T_front_base.inverse(), scan
                break


def _verified(both: MapSession, scan: int, parameters: GraphMapperParameters, rng: Generator) -> list[Loop]:
    """Accepted loops between the places around a keyscan and those of the old map; none if too few are."""
    first_place = both.first_place
    closer = LoopCloser(both.places, both.scans, parameters.loops, rng, first=first_place)
    place = both.places.place_of(scan)
    tried = range(max(place - AROUND, first_place), min(place + AROUND + 1, len(both.places)))
    return loops_of_most(closer, tried, min(_AGREE, len(tried)))


def loops_of_most(closer: LoopCloser, tried: Iterable[int], least: int, among: I64 | None = None) -> list[Loop]:
    """The first accepted loop of each place `tried`, with those `among` others; none if they are fewer than `least`."""
    accepted = ([loop for loop in closer.connections(place, among) if loop.accepted] for place in tried)
    loops = [found[0] for found in accepted if found]
    return loops if len(loops) >= least else []
