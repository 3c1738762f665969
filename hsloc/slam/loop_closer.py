"""Loop closing: submaps that were visited before.

Places are visited in their order. Those seen before that could be near, by a drift that is assumed too large rather
than too small, are compared (`hsloc.slam.loop_matcher`). A loop that is believed becomes an edge of the pose graph
with a covariance and a robust weight, and the graph is solved before the next place is looked at. What was refused is
searched again once more is known; a loop that the solved graph contradicts is refused in the end.
"""

from __future__ import annotations

from dataclasses import replace
from math import hypot, radians, sqrt
from typing import TYPE_CHECKING

import numpy as np

from hsloc.errors import MapError
from hsloc.kernels.normal_equations import path_lengths
from hsloc.model.pose2 import Pose2, relative_poses
from hsloc.slam.loop_groups import corroborated
from hsloc.slam.loop_matcher import Loop, LoopMatcher
from hsloc.slam.pose_graph import Edges, edge_errors, solve_edges

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.random import Generator
    from numpy.typing import NDArray

    from hsloc.slam.keyscans import KeyScans
    from hsloc.slam.loop_matcher import LoopParameters
    from hsloc.slam.submaps import Submaps

    F64 = NDArray[np.float64]

TORN = "torn"
"""How the reason begins for which such a loop is refused."""
ASSERTED = "asserted"
"""The reason of a loop that the user states."""
_SWEEPS = 3
"""Times that all places are visited at most."""
_WIDENED = (16.0, 8.0, 4.0, 2.0)
"""Factors of the robust scales in the first rounds of a solve."""
_STILL = 1e-3
"""A solve between two loops ends when no place moves farther (m; rad): the windows are metres wide."""
_OFF_M = 0.1
"""Distance [m] by which a new loop may be off in the graph before that is solved again: a cell of the fields that the
windows are searched on."""
_OFF_RAD = 0.02
"""And the angle [rad]: as much at 5 m."""
_NARROWER = 0.7
"""A pair is searched again if its window is narrower than before by this factor."""
_CONNECTED_PATH_LENGTH = 12.0
"""Path length (m) after which a pose is as uncertain as one that the global search found. Internal: it only sizes the
window of the first loops of a map that is extended, which are checked as all loops are."""


class LoopCloser:
    """State: poses of the places, and the loops found so far."""

    def __init__(
        self,
        places: Submaps,
        scans: KeyScans,
        parameters: LoopParameters,
        rng: Generator,
        known: tuple[Loop, ...] = (),
        first: int = 0,
        asserted: tuple[tuple[int, int], ...] = (),
        forbidden: tuple[tuple[int, int], ...] = (),
    ) -> None:
        """`known` loops are believed, and places before `first` visited already.

        Of `asserted` pairs of places the user knows that they are one place, of `forbidden` ones that they are not.
        """
        self._places = places
        self._parameters = parameters
        self._matcher = LoopMatcher(places, scans, parameters, rng)
        self.poses = places.poses[places.reference].copy()
        self._found = {(loop.first, loop.second): loop for loop in known}
        self._accepted: list[Loop] | None = None
        self._first = first
        self._unsolved = False
        self._asserted = set(asserted)
        self._forbidden = forbidden

    @property
    def loops(self) -> list[Loop]:
        """All that were searched for, in the order of their places."""
        return [self._found[pair] for pair in sorted(self._found, key=lambda pair: (pair[1], pair[0]))]

    @property
    def accepted(self) -> list[Loop]:
        """The loops that were believed, in the same order."""
        if self._accepted is None:
            self._accepted = [loop for loop in self.loops if loop.accepted]
        return self._accepted

    def _note(self, loop: Loop) -> None:
        """Keep what was found between two places, in place of what was known."""
        pair = loop.first, loop.second
        before = self._found.get(pair)
        if loop.accepted or (before is not None and before.accepted):
            self._accepted = None
        self._found[pair] = loop

    def close(self, progress: Callable[[float], None] | None = None, with_corroborated: bool = False) -> None:
        """Visit all places in their order, and again as long as loops are found or refused.

        `with_corroborated`: accept loops that only look through walls, if others bear them out.
        Raises MapError if the scans of two places disagree that are asserted to be one.
        """
        for old, place in sorted(self._asserted):
            self._assert(old, place)
        if self._found:
            self.solve()
        for sweep in range(_SWEEPS):
            found = 0
            for place in range(self._first, len(self._places)):
                found += self._visit(place)
                if progress is not None:
                    progress((sweep + (place + 1) / len(self._places)) / _SWEEPS)
            if self._unsolved:
                self.solve()
            found += self._believe_corroborated() if with_corroborated else 0
            torn = self._tear()
            if found == 0 and torn == 0:
                break

    def connections(self, place: int, among: NDArray[np.int64] | None = None) -> list[Loop]:
        """What is found between a place and the nearest of others, its pose being nearly known.

        The others are `among`, of another piece of the path, or those before `first`.
        """
        others = np.arange(self._first) if among is None else among
        distance = np.hypot(*(self.poses[others, :2] - self.poses[place, :2]).T)
        order = np.argsort(distance, kind="stable")
        near = [int(k) for k in others[order[distance[order] < self._parameters.search_radius]]]
        near = [other for other in near if not self._is_forbidden(min(other, place), max(other, place))]
        return [
            self._search(min(other, place), max(other, place), _CONNECTED_PATH_LENGTH)
            for other in near[: self._parameters.max_candidates]
        ]

    def edges(self) -> Edges:
        """The accepted loops as edges between the places."""
        return loop_edges(self.accepted, np.arange(len(self._places)), self._parameters.robust)

    def solve(self) -> None:
        """Solve the graph of the places: the front end's steps, and the loops with robust weights."""
        places = self._places
        steps = Edges.chain(places.steps, places.covariances, places.uncertain)
        self.poses = solve_edges(self.poses, Edges.concatenate([steps, self.edges()]), still=_STILL, widened=_WIDENED)
        self._unsolved = False

    def _visit(self, place: int) -> int:
        """Search the candidates of a place that are not known yet; returns how many loops were accepted."""
        searched = 0
        new: list[Loop] = []
        left = self._unknown(place)
        while left and searched < self._parameters.max_candidates:
            old, path_length = left[0]
            loop = self._search(old, place, path_length)
            self._note(loop)
            searched += 1
            new += [loop] if loop.accepted else []
            # What the loop ties to this place need not be searched any more.
            left = self._unknown(place) if loop.accepted else left[1:]
        if new:
            self._unsolved = True
            if self._contradict(new):
                self.solve()
        return len(new)

    def _believe_corroborated(self) -> int:
        """Accept the loops that only look through walls and that others bear out; returns how many."""
        found = 0
        for loop in corroborated(self.loops, self._places):
            if not self._is_forbidden(loop.first, loop.second):
                again = self._matcher.corroborated(loop)
                self._note(again)
                found += again.accepted
        if found > 0:
            self.solve()
        return found

    def _assert(self, old: int, place: int) -> None:
        """Measure a loop that the user asserts: that another pose would fit as well is decided by that."""
        path_length = float(self._places.path_length[place] - self._places.path_length[old])
        loop = self._search(old, place, path_length)
        if not loop.accepted and not loop.is_ambiguous:
            raise MapError(
                f"--assert-loop: the scans of the two places disagree: {loop.reason}; give times at which the robot "
                "was at one place, looking the same way"
            )
        self._note(replace(loop, accepted=True, reason=ASSERTED))

    def _is_forbidden(self, old: int, place: int) -> bool:
        """Whether the user forbids a loop; a place is compared together with its neighbours."""
        return any(abs(old - first) <= 1 and abs(place - second) <= 1 for first, second in self._forbidden)

    def _contradict(self, loops: list[Loop]) -> bool:
        """Whether one of these is off by more than noise in the graph as it is solved; if none is, solving can wait."""
        edges = loop_edges(loops, np.arange(len(self._places)), self._parameters.robust)
        distance, angle, chi = edge_errors(self.poses, edges)
        return bool(((distance > _OFF_M) | (angle > _OFF_RAD) | (chi > 1.0)).any())

    def _unknown(self, place: int) -> list[tuple[int, float]]:
        """Candidates that were not searched, or in a much wider window, and the path length to each."""
        unknown = []
        for old, path_length in self._candidates(place):
            if self._is_forbidden(old, place):
                continue
            before = self._found.get((old, place))
            if before is None or self._window(path_length)[0] < _NARROWER * before.window[0]:
                unknown.append((old, path_length))
        return unknown

    def _tear(self) -> int:
        """Refuse the loop that the solved graph contradicts most, until it contradicts none; returns how many."""
        torn = 0
        while accepted := self.accepted:
            _, _, chi = edge_errors(self.poses, self.edges())
            chi[[(loop.first, loop.second) in self._asserted for loop in accepted]] = 0.0
            worst = int(np.argmax(chi))
            if not chi[worst] > self._parameters.max_edge_chi:
                break
            loop = accepted[worst]
            reason = f"{TORN}: {chi[worst]:.0f} sigma off, the graph solved"
            self._note(replace(loop, accepted=False, reason=reason))
            torn += 1
            self.solve()
        return torn

    def _candidates(self, place: int) -> list[tuple[int, float]]:
        """Old places that could be near, nearest first, with the path length to each over the graph."""
        p = self._parameters
        path_length = self._path_lengths(place)
        old = np.arange(place)
        distance = np.hypot(*(self.poses[:place, :2] - self.poses[place, :2]).T)
        # Submaps next to each other contain the same scans: those would match themselves.
        apart = place - old > 3
        could = (
            apart
            & (path_length >= p.min_path_length)
            & (distance <= p.search_radius + p.sigmas * p.drift * path_length)
        )
        order = np.lexsort((old[could], distance[could]))
        chosen: list[tuple[int, float]] = []
        for candidate in old[could][order]:
            if all(abs(candidate - other) > 2 for other, _ in chosen):
                chosen.append((int(candidate), float(path_length[candidate])))
            if len(chosen) == p.max_candidates:
                break
        return chosen

    def _path_lengths(self, place: int) -> F64:
        """Metres from a submap to each earlier one along the path and over closed loops, shape (place,)."""
        # Where two logs, or pieces, are connected the path may lead over submaps that are still to be visited.
        is_one = self._places.piece[-1] == self._places.piece[0]
        last = place if is_one else len(self._places) - 1
        chain = np.maximum(np.diff(self._places.path_length[: last + 1]), 1e-3)
        accepted = self.accepted
        links = np.array([(loop.first, loop.second) for loop in accepted], dtype=np.int64).reshape(-1, 2)
        lengths = np.array([max(hypot(loop.T_first_second.x, loop.T_first_second.y), 0.1) for loop in accepted])
        found = np.empty(len(self._places))
        path_lengths(chain, links, lengths, place, found)
        return found[:place]

    def _window(self, path_length: float) -> tuple[float, float]:
        """Half-widths (m, rad) of the window after a path length (m)."""
        p = self._parameters
        angle = p.sigmas * p.drift_angle * sqrt(path_length) + radians(2.0)
        return p.sigmas * p.drift * path_length + 0.3, min(angle, float(np.pi))

    def _search(self, old: int, place: int, path_length: float) -> Loop:
        centre = Pose2.from_array(relative_poses(self.poses[None, old], self.poses[None, place])[0])
        return self._matcher.search(old, place, centre, self._window(path_length))


def loop_edges(accepted: list[Loop], nodes: NDArray[np.int64], robust: float) -> Edges:
    """Accepted loops as edges of a graph in which place k is node `nodes[k]`; `robust` is the Cauchy scale on chi."""
    if not accepted:
        return Edges.none()
    return Edges(
        np.array([(nodes[loop.first], nodes[loop.second]) for loop in accepted], dtype=np.int64),
        np.array([loop.T_first_second.to_array() for loop in accepted]),
        np.asarray(np.linalg.inv(np.array([loop.covariance for loop in accepted])), dtype=np.float64),
        np.full(len(accepted), robust),
    )
