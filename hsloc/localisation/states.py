"""The state of each pose of a run in hindsight: localised, predicted, ambiguous, off the map, or lost; and why."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from hsloc.localisation.joined_tracks import joined_begins
from hsloc.localisation.kalman_filter import SETTLED, predict_covariance
from hsloc.localisation.track_evidence import CONFIDENCE, States, TrackRow, mirrored_map, smooth, usual_explained
from hsloc.model.estimate import Ambiguity, Evidence, LikelyPlace, State, Status
from hsloc.model.pose2 import Pose2
from hsloc.model.verdict import spans_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from hsloc.localisation.motion_models import MotionModel
    from hsloc.model.estimate import Estimate

    F64 = NDArray[np.float64]
    from hsloc.model.occupancy_grid import OccupancyGrid

MAX_SIGMA = 0.1
"""Largest standard deviation of a localised pose in any direction (m): 2.5 of them are 0.25 m."""
MAX_SIGMA_ANGLE = np.radians(2.0)
"""And of its heading (rad): 2.5 of them are 5 deg."""
_WITHIN = 2.5
"""Standard deviations that an error of a localised pose stays within."""
_POOR_FIT = 0.92
"""Explained fitness by the usual one below which a doubted pose is taken for off the map."""
_CONTRADICTED = "scans fit, but by the odometry other stretches of the run are elsewhere"
_OTHER_MAP = "scans fit, but not for long: the map may be of another place"
_MIRRORED = "the scans fit the map better when they are mirrored"


@dataclass(frozen=True, slots=True, eq=False)
class StateRows:
    """Columns of n rows: states, their probability, standard deviations (n, 3) in m, m, rad, fitness and reason.

    `mirrored` is the probability that the map is mirrored, of all rows.
    """

    state: tuple[State, ...]
    probability: F64
    sigma: F64
    fitness: F64
    reason: tuple[str, ...]
    mirrored: float = 0.0

    def __len__(self) -> int:
        return len(self.state)

    def is_localised(self) -> NDArray[np.bool_]:
        """Which rows are localised, shape (n,)."""
        return np.array([state is State.LOCALISED for state in self.state], dtype=np.bool_)


def with_pose_errors(rows: StateRows, errors: F64, reason: str) -> StateRows:
    """The rows with further errors (n, 3) in m, m, rad; where they exceed what is localised a pose is predicted.

    They are known in size and no standard deviations: beside 2.5 of those they have to stay within 0.25 m. In heading
    the root of both squares has to stay within 5 deg: the innovations of the same error have raised its deviation.
    """
    noise, sigma = rows.sigma[:, :2].max(axis=1), np.hypot(rows.sigma, errors)
    is_far = np.hypot(errors[:, 0], errors[:, 1]) > _WITHIN * (MAX_SIGMA - noise)
    is_turned = np.hypot(errors[:, 2], _WITHIN * rows.sigma[:, 2]) > _WITHIN * MAX_SIGMA_ANGLE
    vague = rows.is_localised() & (is_far | is_turned)
    states = tuple(State.PREDICTED if each else state for each, state in zip(vague, rows.state, strict=True))
    reasons = tuple(reason if each else before for each, before in zip(vague, rows.reason, strict=True))
    return replace(rows, state=states, sigma=sigma, reason=reasons)


def with_odometry_alone(
    rows: StateRows,
    poses: F64,
    scanned: tuple[int, int],
    alone: NDArray[np.bool_],
    motion_covariance: Callable[[Pose2], F64],
) -> StateRows:
    """The rows of poses (n, 3) with what the odometry adds to their variances where it is all there is.

    Rows before `scanned[0]` come before the first scan, those from `scanned[1]` on after the last; `motion_covariance`
    (3, 3) is that of a motion. Of the poses `alone` (n,), around which there are no scans, those that are less certain
    than a localised one has to be are predicted.
    """
    first, last = scanned
    n, sigma = len(rows), rows.sigma.copy()
    for origin, walk in ((last - 1, range(last, n)), (first, range(first - 1, -1, -1))):
        if not (0 <= origin < n and np.isfinite(sigma[origin]).all()):
            continue
        begin, covariance, largest = Pose2.from_array(poses[origin]), np.diag(sigma[origin] ** 2), sigma[origin]
        at = poses[origin]
        for k in walk:
            if (poses[k] != at).any():  # a robot at rest stays as certain as it is
                at = poses[k]
                motion = begin.between(Pose2.from_array(at))
                grown = predict_covariance(covariance, begin, motion, motion_covariance(motion))
                largest = np.fmax(largest, np.sqrt(np.diag(grown)))
            sigma[k] = np.fmax(sigma[k], largest)
    with np.errstate(invalid="ignore"):
        is_vague = (sigma[:, :2].max(axis=1) > MAX_SIGMA) | (sigma[:, 2] > MAX_SIGMA_ANGLE)
    vague = rows.is_localised() & is_vague & alone
    states = tuple(State.PREDICTED if each else state for each, state in zip(vague, rows.state, strict=True))
    reasons = tuple(
        f"{_deviation(sigma[k])}, by the odometry alone" if vague[k] else reason for k, reason in enumerate(rows.reason)
    )
    return replace(rows, state=states, sigma=sigma, reason=reasons)


def _deviation(sigma: F64) -> str:
    return f"standard deviation {max(sigma[0], sigma[1]):.2f} m, {np.degrees(sigma[2]):.1f} deg"


class StateLog:
    """Collects the estimates of the scans that say something of the state; `rows` judges them all in hindsight."""

    def __init__(self) -> None:
        self._estimates: list[Estimate] = []
        self._counts: list[int] = []
        self._begins: tuple[States, ...] | None = None

    def add(self, estimate: Estimate, odometry_count: int) -> None:
        """Take the estimate at a scan and the number of odometry messages before; one without evidence is skipped."""
        if estimate.evidence is not None:
            self._estimates.append(estimate)
            self._counts.append(odometry_count)

    def __len__(self) -> int:
        return len(self._estimates)

    @property
    def scanned(self) -> tuple[int, int]:
        """Numbers of odometry messages before the first scan and before the last."""
        return (self._counts[0], self._counts[-1]) if self._counts else (0, 0)

    def join_tracks(self, odometry: F64, model: MotionModel, grid: OccupancyGrid) -> None:
        """Weigh the tracks of the run against each other by the odometry (n, 3) between them and the map."""
        rows, owners = self._tracks()
        if len(odometry) == 0 or not rows:
            return
        self._begins = joined_begins((self._estimates, self._counts, owners), rows, odometry, model, grid)

    def at_odometry(self, n: int, smoothed: Mapping[int, F64] | None = None, between: F64 | float = 0.0) -> StateRows:
        """The states at the n odometry messages: each lies between two scans, and is no surer than either.

        `smoothed` are covariances (3, 3) by the index of a scan, which take the place of those of its estimate, and
        `between` (n, 3) is what the odometry between two scans adds to their variances.
        """
        scans = self.at_scans(smoothed)
        if len(scans) == 0:
            return StateRows((State.LOST,) * n, np.zeros(n), np.full((n, 3), np.nan), np.full(n, np.nan), ("",) * n)
        counts = np.array(self._counts)
        k = np.arange(n)
        before = np.searchsorted(counts, k, side="right") - 1
        after = np.minimum(before + 1, len(scans) - 1)
        before = np.maximum(before, 0)
        worse = np.where(_rank(scans, before) >= _rank(scans, after), before, after)
        # A pose before the first match of a new track belongs to the old one unless it was revised.
        span = np.maximum(counts[after] - counts[before], 1)
        part = np.clip((k - counts[before]) / span, 0.0, 1.0)[:, None]
        variance = (1.0 - part) * scans.sigma[before] ** 2 + part * scans.sigma[after] ** 2
        return StateRows(
            tuple(scans.state[i] for i in worse),
            np.minimum(scans.probability[before], scans.probability[after]),
            np.sqrt(variance + between),
            scans.fitness[before],
            tuple(scans.reason[i] for i in worse),
            scans.mirrored,
        )

    def at_scans(self, smoothed: Mapping[int, F64] | None = None) -> StateRows:
        """The states at the scans that were added; `smoothed` as for `at_odometry`."""
        rows, owners = self._tracks()
        probabilities = smooth(rows, self._begins)
        own = probabilities if self._begins is None else smooth(rows)
        mirrored = mirrored_map(rows)
        kept = min((1.0 - mirrored) / (1.0 - mirrored_map(())), 1.0)  # without evidence for it nothing changes
        usual = usual_explained(rows)
        sigma = self._sigma(owners, smoothed or {})
        states: list[State] = []
        reasons: list[str] = []
        probability = np.zeros(len(self._estimates))
        for k, estimate in enumerate(self._estimates):
            owner = owners[k]
            if owner < 0:
                states.append(estimate.state or State.LOST)
                reasons.append(estimate.reason)
                continue
            probability[k] = probabilities[owner, 0] * kept
            state, reason = _judge(probabilities[owner], sigma[k], usual, rows[: owner + 1])
            if probability[k] < CONFIDENCE <= own[owner, 0]:
                contradicted = _OTHER_MAP if self._begins is not None and len(self._begins) == 1 else _CONTRADICTED
                state, reason = State.LOST, _MIRRORED if mirrored > 1.0 - CONFIDENCE else contradicted
            states.append(state)
            reasons.append(reason or estimate.reason)
        fitness = np.array([np.nan if e.fitness is None else e.fitness for e in self._estimates])
        return StateRows(tuple(states), probability, sigma, fitness, tuple(reasons), mirrored)

    def ambiguities(self) -> tuple[Ambiguity, ...]:
        """The stretches of the scans that are ambiguous, with the places between which they do not decide."""
        rows, owners = self._tracks()
        probabilities = smooth(rows, self._begins)
        several = [
            estimate.state is State.AMBIGUOUS if owner < 0 else _is_ambiguous(probabilities[owner])
            for estimate, owner in zip(self._estimates, owners, strict=True)
        ]
        found = []
        for first, last in spans_of(np.array(several, dtype=np.bool_)):
            # A search and the track that follows it know of different places.
            is_guess = [owner < 0 for owner in owners[first : last + 1]]
            edges = [first, *(first + k for k in range(1, len(is_guess)) if is_guess[k] != is_guess[k - 1]), last + 1]
            for begin, end in pairwise(edges):
                at, places = self._places(end - 1, begin, owners, probabilities)
                if len(places) > 1:
                    first_ns, last_ns, at_ns = (self._estimates[k].stamp_ns for k in (begin, end - 1, at))
                    found.append(Ambiguity(first_ns, last_ns, at_ns, places))
        return tuple(found)

    def _places(
        self, last: int, first: int, owners: Sequence[int], probabilities: F64
    ) -> tuple[int, tuple[LikelyPlace, ...]]:
        """The last scan up to `last` that knows of several places, and these.

        Of a search it is one from `first` on; of a track the comparison with the whole map may lie before.
        """
        if owners[last] < 0:
            at = next((k for k in range(last, first - 1, -1) if self._estimates[k].places), last)
            return at, self._estimates[at].places
        right, alike, _ = probabilities[owners[last]]
        for k in range(last, -1, -1):
            estimate = self._estimates[k]
            other = None if estimate.evidence is None else estimate.evidence.other
            if other is not None and owners[k] >= 0:
                both = (LikelyPlace(estimate.T_map_base, float(right)), LikelyPlace(other, float(alike)))
                return k, tuple(sorted(both, key=lambda place: -place.probability))
            if estimate.status is Status.RELOCALISED:
                break
        return last, ()

    def _tracks(self) -> tuple[list[TrackRow], list[int]]:
        """The rows of all tracks, and of each scan its row; -1 for a guess that no later search revised."""
        rows: list[TrackRow] = []
        owners = [-1] * len(self._estimates)
        for k, estimate in enumerate(self._estimates):
            assert estimate.evidence is not None
            if estimate.status is Status.SEARCHING:
                continue
            begins = not rows or estimate.status is Status.RELOCALISED
            owners[k] = len(rows)
            rows.append(TrackRow(estimate.status, estimate.evidence, begins))
            if estimate.revision:
                since = estimate.revision[0].odometry_count
                for j in range(k - 1, -1, -1):
                    if self._counts[j] < since or owners[j] >= 0:
                        break
                    owners[j] = owners[k]
        return rows, owners

    def _sigma(self, owners: Sequence[int], smoothed: Mapping[int, F64]) -> F64:
        """Standard deviations (n, 3): of a guess unknown; of refused scans between agreeing matches interpolated."""
        n = len(self._estimates)
        sigma = np.full((n, 3), np.nan)
        revised: dict[int, F64 | None] = {}
        for k in range(n - 1, -1, -1):
            estimate = self._estimates[k]
            if owners[k] < 0:
                continue
            if estimate.revision:
                revised = {each.odometry_count: each.covariance for each in estimate.revision}
            is_revised = k + 1 < n and owners[k] == owners[k + 1]
            of_trace = revised.get(self._counts[k]) if is_revised else None
            covariance = smoothed.get(k, estimate.covariance) if of_trace is None else of_trace
            if covariance is not None:
                sigma[k] = np.sqrt(np.maximum(np.diag(covariance), 0.0))
            elif is_revised:
                sigma[k] = sigma[k + 1]
            if estimate.status is Status.RELOCALISED:
                # Before it the scans were matched backwards, and are as sure as those matched forwards after it.
                settled = next((j for j in range(k + SETTLED, k, -1) if j < n and owners[j] - owners[k] == j - k), k)
                sigma[k] = np.fmin(sigma[k], sigma[settled])
        return sigma


def _rank(scans: StateRows, index: NDArray[np.int64]) -> NDArray[np.int64]:
    order = {State.LOCALISED: 0, State.PREDICTED: 1, State.AMBIGUOUS: 2, State.OFF_MAP: 3, State.LOST: 4}
    ranks = np.array([order[state] for state in scans.state])
    return np.asarray(ranks[index])


def _is_ambiguous(probabilities: F64) -> bool:
    """Whether it is another place that makes a row of a track unsure."""
    right, alike, astray = probabilities
    return bool(right < CONFIDENCE and alike > astray)


def _judge(probabilities: F64, sigma: F64, usual: float, before: Sequence[TrackRow]) -> tuple[State, str]:
    """The state of a row of a track, and the reason where it is not localised."""
    if _is_ambiguous(probabilities):
        return State.AMBIGUOUS, _named_rival(before)
    if probabilities[0] < CONFIDENCE:
        evidence = _last_explained(before)
        if evidence is not None and evidence.explained < _POOR_FIT * usual:
            return State.OFF_MAP, f"the map explains {evidence.explained:.2f} of the scan, usually {usual:.2f}"
        return State.LOST, "scans before or after do not fit"
    if not (max(sigma[0], sigma[1]) <= MAX_SIGMA and sigma[2] <= MAX_SIGMA_ANGLE):
        return State.PREDICTED, _deviation(sigma)
    return State.LOCALISED, ""


def _named_rival(rows: Sequence[TrackRow]) -> str:
    """The other place of the last comparison, where it was found."""
    for row in reversed(rows):
        if np.isfinite(row.evidence.rival):
            other = row.evidence.other
            if other is None:
                break
            place = f"x {other.x:z.1f} m, y {other.y:z.1f} m, yaw {np.degrees(other.theta):z.0f} deg"
            return f"another place fits as well: {place} at the last comparison"
        if row.begins:
            break
    return "another place fits as well"


def _last_explained(rows: Sequence[TrackRow]) -> Evidence | None:
    for row in reversed(rows[-5:]):
        if np.isfinite(row.evidence.explained):
            return row.evidence
    return None
