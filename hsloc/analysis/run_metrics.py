"""metrics.json and timings.json: what a run measured."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, TypedDict

import numpy as np

from hsloc.errors import EvaluationError
from hsloc.evaluation import evaluate, evaluate_relations, read_relations
from hsloc.evaluation.association import AssociationMethod, associate
from hsloc.evaluation.map_quality import compare_maps, crispness
from hsloc.evaluation.metrics import compare
from hsloc.log import LaserSummary
from hsloc.model.trajectory import Trajectory
from hsloc.version import __version__

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from hsloc.analysis.residuals import Residuals
    from hsloc.replay.run import Result

_MOST = 0.5
"""Of the sparser trajectory's poses, the part that must have a partner nearby."""


class Pairing(TypedDict, total=False):
    """Arguments of `hsloc.evaluation.evaluate`."""

    association: AssociationMethod
    max_difference_s: float


def metrics(
    result: Result,
    residuals: Residuals,
    alignment: str | None = None,
    relations: Path | None = None,
    doubts: Sequence[str] = (),
) -> dict[str, object]:
    """The content of metrics.json: the same for the same run, wall times left out.

    `alignment` of the trajectory with the truth: by default none on a given map, and se2 on one that was drawn, whose
    frame is its own. `relations` is a file for the metric [K], `doubts` are warnings besides the result's own.
    """
    diagnostics = result.diagnostics
    status = Counter(diagnostics.status)
    pairs = zip(diagnostics.status, diagnostics.reason, strict=True)
    reasons = Counter(f"{state}: {_kind(reason)}" if reason else state for state, reason in pairs)
    fitness = diagnostics.fitness[np.isfinite(diagnostics.fitness)]
    spec = result.spec
    values: dict[str, object] = {
        "run": {
            "hsloc": __version__,
            "mode": result.mode,
            "inputs": list(spec.names()),
            "input_sha256": result.input_sha256,
            "map": _map_name(result),
            "seed": spec.seed,
            "preset": spec.preset,
            "matcher": spec.config.matcher,
        },
        "log": {
            "duration_s": duration(result),
            "odometry_messages": len(result.odometry),
            "path_length_m": result.trajectory.length(),
            **_read(result),
        },
        "scans": {
            "total": len(diagnostics),
            "used": status["matched"] + status["relocalised"],
            "by_status": dict(sorted(status.items())),
            "by_reason": dict(sorted(reasons.items())),
        },
        "evaluations": {
            "total": int(diagnostics.evaluations.sum()),
            "median_per_match": _median(diagnostics.evaluations[diagnostics.evaluations > 0]),
        },
        "fitness": {"median": _median(fitness), "p05": float(np.percentile(fitness, 5)) if len(fitness) else None},
        "map": _map_quality(result, residuals),
        "localised": {"share_of_poses": float(result.localised.mean()) if len(result.localised) else 0.0},
        "losses": {"data_lost": result.losses.data_lost, "notes": result.losses.lines()},
        "warnings": [*result.warnings, *doubts],
    }
    if result.reference is not None and len(result.reference) > 1:
        chosen = alignment or ("se2" if result.mode == "slam" else "none")
        values |= _against(result.trajectory, result.reference, chosen)
        if not result.localised.all() and result.localised.any():
            believed = Trajectory(
                result.trajectory.stamps_ns[result.localised], result.trajectory.poses[result.localised]
            )
            values["localised_only"] = _against(believed, result.reference, chosen)
    if relations is not None:
        values["relations"] = evaluate_relations(result.trajectory, read_relations(relations)).to_dict()
    return values


def _read(result: Result) -> dict[str, object]:
    """What of the log was read, and from when on."""
    summary, stamps = result.summary, result.trajectory.stamps_ns
    lasers = summary.lasers or (
        LaserSummary(summary.scan_topic or "", summary.laser_frame or "", summary.T_base_laser, summary.laser_flipped,
                     summary.extrinsics),
    )  # fmt: skip
    truth = summary.truth_topic if result.spec.reference is None else result.spec.reference
    return {
        "first_stamp_ns": int(stamps.min()) if len(stamps) else None,
        "odometry": None if result.spec.no_odometry else summary.odom_topic,
        "reference": None if result.reference is None else truth,
        "lasers": [laser.to_dict() for laser in lasers],
    }


def _map_name(result: Result) -> str:
    if result.mode == "slam":
        return "drawn" if result.spec.resume is None else f"{result.spec.resume.name}, extended"
    return "log" if result.spec.map_path is None else result.spec.map_path.name


def _map_quality(result: Result, residuals: Residuals) -> dict[str, object]:
    """How well scans and map agree; for a drawn map also how crisp and how consistent it is, and against a true one."""
    values: dict[str, object] = {"residuals": residuals.to_dict()}
    if result.mode != "slam":
        return values
    values["crispness"] = crispness(result.grid).to_dict()
    if result.mapping is not None:
        values["mapping"] = result.mapping.quality.to_dict()
    if result.true_grid is not None and result.reference is not None:
        try:
            options = pairing(result.trajectory, result.reference)
            moved = compare(result.trajectory, result.reference, alignment="se2", **options).T_reference_estimate
            values["comparison"] = compare_maps(result.grid, result.true_grid, T_truth_map=moved).to_dict()
        except EvaluationError as error:
            values["comparison_error"] = str(error)
    return values


def timings(result: Result) -> dict[str, object]:
    """Wall times: what differs from one run to the next."""
    work = result.seconds["replay"] + result.seconds.get("finish", 0.0)
    return {
        "seconds": result.seconds,
        "times_real_time": duration(result) / work if work > 0.0 else None,
        "evaluations_per_second": int(result.diagnostics.evaluations.sum()) / work if work > 0.0 else None,
    }


def duration(result: Result) -> float:
    """Seconds of the log from the first to the last pose."""
    stamps = result.trajectory.stamps_ns
    return float(stamps.max() - stamps.min()) / 1e9 if len(stamps) else 0.0


def pairing(trajectory: Trajectory, reference: Trajectory) -> Pairing:
    """How to pair the poses: the nearest within 10 ms, as evo does, if most of the sparser trajectory finds one.

    Else the denser one is interpolated, across gaps of up to a second: a reference at 1 Hz has no pose within 10 ms of
    one of a robot's that was seen at 7 Hz.
    """
    try:
        found = associate(reference, trajectory)
        if len(found) >= _MOST * min(len(reference), len(trajectory)):
            return {}
    except EvaluationError:
        pass
    denser = max(trajectory, reference, key=len)
    usual = float(np.median(np.diff(np.sort(denser.stamps_ns)))) / 1e9 if len(denser) > 1 else 0.0
    return {"association": "interpolation", "max_difference_s": min(max(0.75 * usual, 0.01), 1.0)}


def _against(trajectory: Trajectory, reference: Trajectory, alignment: str) -> dict[str, object]:
    try:
        return evaluate(trajectory, reference, alignment=alignment, **pairing(trajectory, reference)).to_dict()
    except EvaluationError as error:
        return {"evaluation_error": str(error)}


def _kind(reason: str) -> str:
    """A reason without its figures, so that reasons can be counted."""
    return " ".join(word for word in reason.split() if not any(c.isdigit() for c in word)).rstrip(",")


def _median(values: NDArray[np.float64] | NDArray[np.int64]) -> float | None:
    return float(np.median(values)) if len(values) else None
