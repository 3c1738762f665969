"""Stretches of the way, each with its keyscans: what loops are closed between."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hsloc.kernels.score_field import thinned_cloud
from hsloc.localisation.kalman_filter import predict_covariance
from hsloc.model.pose2 import IDENTITY, Pose2, compose_poses, relative_poses
from hsloc.slam.local_map import LocalMap

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.slam.keyscans import KeyScans

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]


UNKNOWN_STEP = 1e6 * np.eye(3)
"""Covariance of a step that nothing measured (m^2, rad^2). Internal: larger than any building."""
_FAR = 1e4
"""Path length (m) between two logs that no loop connects yet. Internal: any length beyond all drift."""


@dataclass(frozen=True, slots=True, eq=False)
class Submaps:
    """Submap k holds keyscans start[k] to start[k + 1]; its frame is that of its middle one, `reference[k]`.

    `poses` (n, 3) are the front end's, of the keyscans; within a few places they are taken to be rigid. `steps`
    (m - 1, 3) and `covariances` (m - 1, 3, 3) lead to each submap's reference in the frame of the one before.
    """

    start: I64
    reference: I64
    poses: F64
    steps: F64
    covariances: F64
    uncertain: NDArray[np.bool_]
    """Steps (m - 1,) on which a match was refused: odometry alone, which may have slipped."""
    path_length: F64
    """Metres driven until each reference, shape (m,), with `refused_path_length` more for each refused match."""
    piece: I64
    """Shape (m,): where one log ends and the next begins the number changes; nothing is rigid across that."""

    def __len__(self) -> int:
        return len(self.reference)

    @staticmethod
    def split_by_path_length(
        poses: F64,
        motions: F64,
        covariances: F64,
        length: float,
        turn_length: float,
        refused: NDArray[np.bool_] | None = None,
        refused_path_length: float = 0.0,
        gaps: NDArray[np.bool_] | None = None,
    ) -> Submaps:
        """Submaps of `length` metres of the path; `motions` and `covariances` lead to each keyscan.

        A rotation of one radian counts as `turn_length` metres, a refused match as `refused_path_length`. At `gaps`
        (n,) nothing leads to a keyscan from the one before: there a submap begins.
        """
        refused = np.zeros(len(poses), dtype=bool) if refused is None else refused
        gaps = np.zeros(len(poses), dtype=bool) if gaps is None else gaps
        step = np.hypot(motions[:, 0], motions[:, 1]) + turn_length * np.abs(motions[:, 2])
        way = np.cumsum(np.where(gaps, _FAR, step))
        index = np.floor(way / length).astype(np.int64)
        start = np.concatenate((np.flatnonzero(np.diff(index, prepend=-1)), [len(poses)])).astype(np.int64)
        reference = (start[:-1] + start[1:]) // 2
        steps = relative_poses(poses[reference[:-1]], poses[reference[1:]])
        count = np.cumsum(refused)
        uncertain = np.diff(count[reference]) > 0
        piece = np.cumsum(gaps)[reference].astype(np.int64)
        chained = _chained(reference, motions, covariances)
        return Submaps(
            start, reference, poses, steps, chained, uncertain, (way + refused_path_length * count)[reference], piece
        )

    def on_path(self, poses: F64, motions: F64, covariances: F64) -> Submaps:
        """The same places on another path; arguments as in `split_by_path_length`."""
        steps = relative_poses(poses[self.reference[:-1]], poses[self.reference[1:]])
        return replace(self, poses=poses, steps=steps, covariances=_chained(self.reference, motions, covariances))

    @staticmethod
    def concatenate(first: Submaps, second: Submaps) -> Submaps:
        """Those of two logs in one map; the step from the first's last to the second's first is unknown."""
        scans = len(first.poses)
        seam = relative_poses(first.poses[None, first.reference[-1]], second.poses[None, second.reference[0]])
        return Submaps(
            np.concatenate((first.start[:-1], scans + second.start)),
            np.concatenate((first.reference, scans + second.reference)),
            np.concatenate((first.poses, second.poses)),
            np.concatenate((first.steps, seam, second.steps)),
            np.concatenate((first.covariances, UNKNOWN_STEP[None], second.covariances)),
            np.concatenate((first.uncertain, [False], second.uncertain)),
            np.concatenate((first.path_length, first.path_length[-1] + _FAR + second.path_length)),
            np.concatenate((first.piece, first.piece[-1] + 1 + second.piece)),
        )

    def place_of(self, scan: int) -> int:
        """The submap that holds a keyscan."""
        return int(np.searchsorted(self.start, scan, side="right")) - 1

    def members(self, place: int, around: int) -> range:
        """Keyscans of a place and of `around` places before and after."""
        same = np.flatnonzero(self.piece[max(place - around, 0) : place + around + 1] == self.piece[place])
        low = max(place - around, 0)
        return range(int(self.start[low + same[0]]), int(self.start[low + same[-1] + 1]))

    def cloud(self, place: int, around: int, scans: KeyScans, max_range: float, cell: float) -> F64:
        """Hits of a place and its neighbours in its frame, one for each cell of side `cell` (m), shape (n, 2)."""
        members = self.members(place, around)
        relative = relative_poses(
            np.broadcast_to(self.poses[self.reference[place]], (len(members), 3)),
            self.poses[members.start : members.stop],
        )
        hits = slice(int(scans.start[members.start]), int(scans.start[members.stop]))
        start = scans.start[members.start : members.stop + 1] - hits.start
        points = scans.points[hits]
        cloud = np.empty((len(points), 2))
        return cloud[: thinned_cloud(points, start, relative, max_range, cell, cloud)]

    def field(
        self, place: int, around: int, scans: KeyScans, max_range: float, resolution: float, sigma: float
    ) -> LocalMap:
        """The field of a place and its neighbours, in its frame."""
        local = LocalMap(resolution, sigma, 3.0 * sigma)
        local.add(self.cloud(place, around, scans, max_range, 0.5 * resolution), saturation_score=0.95)
        return local

    def expand(self, places: F64) -> F64:
        """Poses of all keyscans (n, 3) from poses of the places (m, 3), each keyscan rigid with its place."""
        owner = np.repeat(np.arange(len(self)), np.diff(self.start))
        relative = relative_poses(self.poses[self.reference[owner]], self.poses)
        poses: F64 = compose_poses(places[owner], relative)
        return poses


def _chained(reference: I64, motions: F64, covariances: F64) -> F64:
    """Covariance (m - 1, 3, 3) of the motion from each of the keyscans `reference` (m,) to the next."""
    chained = np.zeros((max(len(reference) - 1, 0), 3, 3))
    for k in range(len(chained)):
        pose, covariance = IDENTITY, np.zeros((3, 3))
        for scan in range(reference[k] + 1, reference[k + 1] + 1):
            motion = Pose2.from_array(motions[scan])
            covariance = predict_covariance(covariance, pose, motion, covariances[scan])
            pose = pose @ motion
        chained[k] = covariance
    return chained
