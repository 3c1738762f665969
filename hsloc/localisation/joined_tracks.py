"""The tracks of a run as they are weighed against each other, and with which probabilities each of them begins then."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hsloc.localisation.odometry_errors import Way
from hsloc.localisation.track_consistency import LEAST, MappedGround, Track, right_tracks
from hsloc.localisation.track_evidence import CONFIDENCE, PRIOR, States, TrackRow, entry_likelihoods, smooth
from hsloc.model.estimate import Status

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from hsloc.localisation.motion_models import MotionModel
    from hsloc.model.estimate import Estimate
    from hsloc.model.occupancy_grid import OccupancyGrid

    F64 = NDArray[np.float64]

Scans = tuple["Sequence[Estimate]", "Sequence[int]", "Sequence[int]"]
"""Of each scan its estimate, the odometry messages before it, and its row of a track or -1."""


def joined_begins(
    scans: Scans, rows: Sequence[TrackRow], odometry: F64, model: MotionModel, grid: OccupancyGrid
) -> tuple[States, ...]:
    """The probabilities with which each track of `rows` begins, by the odometry (n, 3) between them and the map."""
    likelihoods = entry_likelihoods(rows)
    tracks = _as_tracks(scans, rows, likelihoods)
    right = right_tracks(tracks, Way.of(odometry, model), MappedGround(grid), PRIOR)
    return tuple(_began(p, each) for p, each in zip(right.tolist(), likelihoods, strict=True))


def _as_tracks(run: Scans, rows: Sequence[TrackRow], likelihoods: Sequence[States]) -> list[Track]:
    estimates, counts, owners = run
    scans: list[list[int]] = []
    lost: list[list[int]] = []
    for k, (estimate, owner) in enumerate(zip(estimates, owners, strict=True)):
        if estimate.status is Status.SEARCHING:
            if owner < 0 and lost:
                lost[-1].append(k)
            continue
        if rows[owner].begins:
            scans.append([])
            lost.append([])
        scans[-1].append(k)
    messages = np.maximum(np.array(counts) - 1, 0)
    sure = smooth(rows)[:, 0]
    tracks = []
    for own, after, (likelihood, alike, astray) in zip(scans, lost, likelihoods, strict=True):
        right = max(likelihood, LEAST)
        probabilities = sure[[owners[k] for k in own]]
        least = min(CONFIDENCE, float(probabilities.max()))
        leaves = own[int(np.flatnonzero(probabilities >= least)[-1])]
        first, last = estimates[own[0]], estimates[leaves]
        said = (rows[owners[k]].evidence for k in own if k <= leaves)
        tracks.append(
            Track(
                int(messages[own[0]]),
                first.T_map_base,
                int(messages[leaves]),
                last.T_map_base,
                messages[own],
                np.array([estimates[k].T_map_base.theta for k in own]),
                alike / right,
                astray / right,
                messages[after],
                estimates[own[0]].status is Status.RELOCALISED,
                tuple(each for each in said if np.isfinite(each.explained)),
                last.noise_scale,
            )
        )
    return tracks


def _began(right: float, likelihoods: States) -> States:
    """The probabilities with which a track begins, so that with its scans it begins right with probability `right`.

    Other tracks put it in doubt; what its own scans leave open they do not settle.
    """
    wrong = (PRIOR[1] * likelihoods[1], PRIOR[2] * likelihoods[2])
    scale = max((1.0 - right) / (right * sum(wrong)) * likelihoods[0], 1.0 / PRIOR[0])
    total = 1.0 + scale * (PRIOR[1] + PRIOR[2])
    return 1.0 / total, scale * PRIOR[1] / total, scale * PRIOR[2] / total
