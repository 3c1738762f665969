"""What a run leaves behind while it goes: a row for each odometry message, each scan and each truth."""

from __future__ import annotations

from array import array
from dataclasses import replace
from math import isfinite, sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hsloc.localisation.between_matches import between_matches, bridge_variances
from hsloc.localisation.interpolated_odometry import AtStamp
from hsloc.localisation.kalman_filter import Anchor, SmoothedMatches, noise_around, smooth_matches
from hsloc.localisation.motion_models import OdometryNoise
from hsloc.localisation.mounting_changes import piece_errors, yaw_pieces
from hsloc.localisation.mounting_error import mounting_error, steps_of_anchors, steps_of_poses
from hsloc.localisation.revised_poses import composed, revised_matches
from hsloc.localisation.states import StateLog, with_odometry_alone, with_pose_errors
from hsloc.model.estimate import ScanDiagnostics, State, Status
from hsloc.model.events import Odometry, PairedScan, Truth
from hsloc.model.pose2 import Pose2
from hsloc.model.trajectory import Trajectory
from hsloc.preprocessing.scans import half_sweep_ns
from hsloc.replay.matched_scans import are_matched, is_lost, mean_fitness
from hsloc.slam.heading_offset import NANOSECONDS, UNKNOWN, Headings, find_offset, thinned
from hsloc.slam.time_offset import LEAST_AGREEMENT, agreement, find_drift

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from hsloc.localisation.map_scale import MapScale
    from hsloc.localisation.motion_models import MotionModel
    from hsloc.localisation.mounting_changes import YawPiece
    from hsloc.localisation.mounting_error import MountingError
    from hsloc.localisation.states import StateRows
    from hsloc.model.certificate import Certificate
    from hsloc.model.estimate import Ambiguity, Estimate, Revised
    from hsloc.model.occupancy_grid import OccupancyGrid
    from hsloc.slam.heading_offset import Offset
    from hsloc.slam.result import MappingResult

    F64 = NDArray[np.float64]

_SILENT_NS = 1e9
"""Time without scans (ns) from which poses follow the odometry alone: no lidar turns so slowly ..."""
_SILENT_INTERVALS = 3.0
"""... and, in usual intervals of the scans, where a log holds only some of them."""


class _Revision(NamedTuple):
    """What a relocalisation says of the poses before the `end`-th, and the number of its anchor."""

    end: int
    track: tuple[Revised, ...]
    anchor: int


class RunHistory:
    """Columns that grow with the log: the result itself, and all of the memory that does."""

    def __init__(self, motion_model: MotionModel | None = None) -> None:
        """With a motion model the trajectory is smoothed backwards; without, each pose knows the past alone."""
        self._motion_model = motion_model
        self._anchors: list[Anchor] = []
        self._anchor_scans: list[int] = []
        self._anchor_states: list[int] = []
        self._smoothed: SmoothedMatches | None = None
        self._track_ended = True
        self._frames: set[str] = set()
        self._mapped = array("d")
        self._odometry_stamps = array("q")
        self._odometry = array("d")
        self._interpolated: dict[int, AtStamp] = {}
        self._poses = array("d")
        self._localised = array("b")
        self._truth_stamps = array("q")
        self._truth = array("d")
        self._scan_stamps = array("q")
        self._scan_headings = array("d")
        self._half_sweeps_ns = array("q")
        self._status: list[str] = []
        self._reason: list[str] = []
        self._fitness = array("d")
        self._sigma = array("d")
        self._covariance = array("d")
        self._evaluations = array("q")
        self._states = StateLog()
        self._certificates: list[Certificate] = []
        self._believed = 0
        self._searching = False
        self._revisions: list[_Revision] = []

    def add(self, event: Odometry | PairedScan | Truth, estimate: Estimate | None) -> None:
        """Take an event and what the estimator said to it."""
        if isinstance(event, Odometry):
            if estimate is None:
                return
            pose, place = event.T_odom_base, estimate.T_map_base
            if event.interpolation is not None:
                self._interpolated[len(self._odometry_stamps)] = AtStamp(event.stamp_ns, event.interpolation)
            self._odometry_stamps.append(event.stamp_ns)
            self._odometry.extend((pose.x, pose.y, pose.theta))
            self._poses.extend((place.x, place.y, place.theta))
            self._localised.append(estimate.status is not Status.SEARCHING)
        elif isinstance(event, Truth):
            truth = event.T_map_base
            self._truth_stamps.append(event.stamp_ns)
            self._truth.extend((truth.x, truth.y, truth.theta))
        elif estimate is not None:
            self._frames.add(event.scan.frame_id)
            self._half_sweeps_ns.append(half_sweep_ns(event.scan))
            self._add_scan(estimate)
            self._anchor(event, estimate)

    def _add_scan(self, estimate: Estimate) -> None:
        self._note_belief(estimate.status)
        self._states.add(estimate, len(self._odometry_stamps))
        self._scan_stamps.append(estimate.stamp_ns)
        self._scan_headings.append(estimate.T_map_base.theta)
        self._status.append(estimate.status.value)
        self._reason.append(estimate.reason)
        self._fitness.append(float("nan") if estimate.fitness is None else estimate.fitness)
        covariance = estimate.covariance
        if covariance is None:
            self._sigma.extend((float("nan"),) * 3)
            self._covariance.extend((float("nan"),) * 9)
        else:
            values = covariance.ravel().tolist()  # Python's own numbers: this is done for each scan.
            self._sigma.extend(sqrt(max(variance, 0.0)) for variance in values[::4])
            self._covariance.extend(values)
        self._evaluations.append(estimate.evaluations)
        if estimate.certificate is not None:
            self._certificates.append(estimate.certificate)
        if estimate.revision:
            self._revisions.append(_Revision(len(self._odometry_stamps), estimate.revision, len(self._anchors)))

    def _anchor(self, paired: PairedScan, estimate: Estimate) -> None:
        if estimate.status is Status.SEARCHING:
            self._track_ended = True
        is_match = estimate.status in (Status.MATCHED, Status.RELOCALISED)
        if self._motion_model is None and is_match:
            pose, place = paired.T_odom_base, estimate.T_map_base
            self._mapped.extend((pose.x, pose.y, pose.theta, place.x, place.y, place.theta))
        if self._motion_model is not None and is_match and estimate.covariance is not None:
            begins = self._track_ended or estimate.status is Status.RELOCALISED
            self._anchors.append(
                Anchor(
                    len(self._odometry_stamps),
                    paired.T_odom_base,
                    estimate.T_map_base,
                    estimate.covariance,
                    begins,
                    estimate.noise_scale,
                    estimate.fits_as_usual,
                    AtStamp(paired.scan.stamp_ns, paired.interpolation),
                )
            )
            self._anchor_scans.append(len(self._scan_stamps) - 1)
            self._anchor_states.append(-1 if estimate.evidence is None else len(self._states) - 1)
            self._smoothed = None
            self._track_ended = False

    def _note_belief(self, status: Status) -> None:
        """Whoever is lost now has been since the last match that was believed: in hindsight those poses are guesses."""
        if status is Status.MATCHED or status is Status.RELOCALISED:
            self._believed = len(self._localised)
        elif status is Status.SEARCHING and not self._searching:
            for k in range(self._believed, len(self._localised)):
                self._localised[k] = 0
        self._searching = status is Status.SEARCHING

    @property
    def lasers(self) -> int:
        """Lasers so far, by the frames of their scans."""
        return len(self._frames)

    @property
    def scans(self) -> int:
        """Scans so far."""
        return len(self._scan_stamps)

    def odometry(self) -> Trajectory:
        """The odometry, one pose a message."""
        return _trajectory(self._odometry_stamps, self._odometry)

    def clock_offset(self, *, sweeps: bool) -> Offset | None:
        """The offset of the scans' stamps by the headings of the matches as they came, of all lasers together.

        None where these say nothing: most scans found no match, as with an offset of seconds, or turn unlike the
        odometry. `sweeps` says that scans are stamped when they begin, and show the robot in their middle.
        """
        matched = are_matched(self._status)
        if len(matched) == 0 or is_lost(self._status):
            return None
        half_ns = round(float(np.median(np.array(self._half_sweeps_ns)))) if sweeps else 0
        stamps = np.array(self._scan_stamps, dtype=np.int64)[matched] + half_ns
        scans = Headings.of(stamps, np.array(self._scan_headings)[matched])
        odometry = Headings.of(self.odometry().stamps_ns, self.odometry().poses[:, 2])
        # Steps of a fifth of a second keep out what the prediction leaves in single matches. Up to a tenth of the
        # offset may remain hidden, which shows when the log is matched again with the rest removed.
        found = find_offset(thinned(scans), odometry)
        if not isfinite(found.sigma):
            return UNKNOWN
        if agreement(scans, odometry, found.seconds) < LEAST_AGREEMENT:
            return None
        drift_s = find_drift(scans, odometry, found.seconds)
        return found._replace(drift_s=drift_s, half_sweep_s=half_ns / NANOSECONDS)

    def mean_fitness(self) -> float:
        """Of the scans that were matched; 0 without any."""
        return mean_fitness(np.array(self._fitness))

    def reference(self) -> Trajectory | None:
        """The truth of the log, if it has any."""
        return _trajectory(self._truth_stamps, self._truth) if self._truth_stamps else None

    def trajectory(self) -> tuple[Trajectory, np.ndarray[tuple[int], np.dtype[np.bool_]]]:
        """One pose for each odometry message, revised where the estimator knew better later; and which are believed."""
        estimated = _trajectory(self._odometry_stamps, self._poses)
        if self._motion_model is not None and self._anchors:
            matched = self._smooth()
            # Where scans were refused before, the first match may be that of another place.
            is_first = self._anchor_scans[0] == 0
            poses = between_matches(
                estimated.poses,
                self.odometry().poses,
                self._anchors,
                matched,
                leads_to_first=is_first,
                interpolated=self._interpolated,
            )
            estimated = Trajectory(estimated.stamps_ns, poses)
        if not self._revisions:
            return estimated, np.array(self._localised, dtype=np.bool_)
        odometry = self.odometry()
        poses = estimated.poses
        localised = np.array(self._localised, dtype=np.bool_)
        for revision in self._revisions:
            poses = composed(poses, odometry.poses, revision.track, revision.end)
            localised[revision.track[0].odometry_count : revision.end] = True
            if self._motion_model is not None:
                matches = self._revised(revision, odometry, self._motion_model)
                poses = between_matches(poses, odometry.poses, *matches, interpolated=self._interpolated)
        return Trajectory(estimated.stamps_ns, poses), localised

    def _revised(
        self, revision: _Revision, odometry: Trajectory, model: MotionModel
    ) -> tuple[list[Anchor], SmoothedMatches]:
        """The matches of a revision, and the one that it leads to, smoothed."""
        at, smoothed = revision.anchor, self._smooth()
        found = replace(self._anchors[at], T_map_base=Pose2.from_array(smoothed.poses[at]))
        found = replace(found, covariance=smoothed.covariances[at])
        return revised_matches(revision.track, found, noise_around(self._anchors, at), odometry, model)

    def _smooth(self) -> SmoothedMatches:
        """The smoothed poses at the matches; of none without a motion model."""
        if self._motion_model is None:
            return SmoothedMatches(np.empty((0, 3)), np.empty((0, 3, 3)), *np.empty((2, 0, 3)))
        if self._smoothed is None:
            self._smoothed = smooth_matches(self._anchors, self._motion_model)
        return self._smoothed

    def states(
        self,
        scale: MapScale | None = None,
        mounting: MountingError | None = None,
        pieces: Sequence[YawPiece] = (),
        grid: OccupancyGrid | None = None,
    ) -> StateRows | None:
        """The state of each pose of the trajectory in hindsight; None for an estimator that weighs no evidence.

        With the map, `grid`, the tracks of the run are weighed against each other by the odometry between them.
        Where the map has another `scale` than the lidar, or the laser another `mounting` than stated, or from a time on
        (`pieces`), poses are as uncertain as that makes them.
        """
        if len(self._states) == 0:
            return None
        model = self._motion_model or OdometryNoise()
        if grid is not None:
            self._states.join_tracks(self.odometry().poses, model, grid)
        smoothed = self._smooth()
        covariances = dict(zip(self._anchor_states, smoothed.covariances, strict=True))
        odometry = self.odometry()
        between, unsure = bridge_variances(
            odometry.poses, self._anchors, smoothed, model, self._interpolated, stamps_ns=odometry.stamps_ns
        )
        for revision in self._revisions if self._motion_model is not None else ():
            variances, of_slips = bridge_variances(
                odometry.poses,
                *self._revised(revision, odometry, model),
                model,
                self._interpolated,
                stamps_ns=odometry.stamps_ns,
            )
            between, unsure = between + variances, unsure | of_slips
        rows = self._states.at_odometry(len(self._odometry_stamps), covariances, between)
        if self._motion_model is not None:
            noise, factor = self._motion_model, self._anchors[-1].noise_scale if self._anchors else 1.0
            poses = self.trajectory()[0].poses
            rows = with_odometry_alone(
                rows,
                poses,
                self._states.scanned,
                self._is_alone() | unsure,
                lambda motion: factor * noise.covariance(motion),
            )
        if scale is not None and scale.moves_poses:
            reason = f"the scale of the map is {scale.of_given_map:.3f} ± {scale.sigma:.3f}"
            rows = with_pose_errors(rows, scale.pose_errors(self.trajectory()[0].poses), reason)
        if mounting is not None and mounting.is_significant:
            errors = mounting.pose_errors(self.trajectory()[0].poses)
            rows = with_pose_errors(rows, errors, "the laser is mounted elsewhere than stated")
        if pieces:
            errors = piece_errors(pieces, self.trajectory()[0])
            rows = with_pose_errors(rows, errors, "the laser was turned on the robot")
        return rows

    def _is_alone(self) -> NDArray[np.bool_]:
        """Which odometry messages (n,) lie where the lidar gave no scans, at its ends or between."""
        odometry, scans = np.array(self._odometry_stamps), np.sort(np.array(self._scan_stamps))
        after = np.searchsorted(scans, odometry)
        usual = float(np.median(np.diff(scans))) if len(scans) > 1 else 0.0
        bounds = np.array([-np.inf, *scans.tolist(), np.inf])
        found: NDArray[np.bool_] = bounds[after + 1] - bounds[after] > max(_SILENT_NS, _SILENT_INTERVALS * usual)
        return found

    def mounting(self) -> tuple[MountingError | None, tuple[YawPiece, ...]]:
        """How far the laser is from where it is said to be, or parts of the run in which it looks the same way.

        Neither where that is not known, or with several lasers. Of a map that is built only the yaw, and a part of it:
        its scans are matched to each other with the odometry; the finished map says when the laser was turned.
        """
        steps, is_mapped = None, self._motion_model is None
        if len(self._frames) == 1:
            poses = np.array(self._mapped).reshape(-1, 6)
            steps = steps_of_poses(poses[:, :3], poses[:, 3:]) if is_mapped else steps_of_anchors(self._anchors)
        if steps is None:
            return None, ()
        stamps = np.arange(len(self._mapped) // 6)
        if not is_mapped:
            counts = np.array([anchor.count for anchor in self._anchors])
            stamps = np.array(self._odometry_stamps)[np.maximum(counts - 1, 0)]
        pieces = yaw_pieces(steps, stamps)
        error = None if pieces else mounting_error(steps)
        return error.of_yaw() if error is not None and is_mapped else error, pieces

    def ambiguities(self, states: StateRows | None) -> tuple[Ambiguity, ...]:
        """Between which places the run does not decide, and when; `states` are those of its poses."""
        return () if states is None or State.AMBIGUOUS not in states.state else self._states.ambiguities()

    def mapped(self, mapping: MappingResult) -> tuple[Trajectory, NDArray[np.bool_]]:
        """The trajectory on a built map: at the odometry messages, or at the scans if there are none."""
        stamps, poses = self.odometry().stamps_ns, mapping.odometry_poses
        if len(stamps) == 0:
            stamps, poses = self.diagnostics().stamps_ns, mapping.scan_poses
        return Trajectory(stamps, poses), np.ones(len(stamps), dtype=np.bool_)

    def diagnostics(self, mapping: MappingResult | None = None) -> ScanDiagnostics:
        """One row for each scan; covariances are those of the smoothed poses where these are smoothed.

        Of a map that was built they are those of the solved graph.
        """
        covariance = np.array(self._covariance, dtype=np.float64).reshape(-1, 3, 3)
        sigma = np.array(self._sigma, dtype=np.float64).reshape(-1, 3)
        smoothed = self._smooth().covariances
        covariance[self._anchor_scans] = smoothed
        sigma[self._anchor_scans] = np.sqrt(np.maximum(np.diagonal(smoothed, axis1=1, axis2=2), 0.0))
        if mapping is not None:
            covariance = mapping.scan_covariances
            sigma = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
        return ScanDiagnostics(
            stamps_ns=np.array(self._scan_stamps, dtype=np.int64),
            status=tuple(self._status),
            fitness=np.array(self._fitness, dtype=np.float64),
            sigma=sigma,
            evaluations=np.array(self._evaluations, dtype=np.int64),
            reason=tuple(self._reason),
            covariance=covariance,
            certificates=tuple(self._certificates),
        )


def _trajectory(stamps: array[int], poses: array[float]) -> Trajectory:
    """A view of the columns, which can grow no more while it lives: an hour's would be large to copy."""
    return Trajectory(np.frombuffer(stamps, dtype=np.int64), np.frombuffer(poses, dtype=np.float64).reshape(-1, 3))
