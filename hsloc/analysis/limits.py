"""Limits for unattended use: which of those that a request states its result does not keep."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hsloc.model.verdict import Verdict

if TYPE_CHECKING:
    from hsloc.request import RunRequest
    from hsloc.run_metrics import RunMetrics

_FAILING = {"failed": (Verdict.FAILED,), "check": (Verdict.FAILED, Verdict.CHECK)}


def exceeded_limits(request: RunRequest, metrics: RunMetrics) -> tuple[str, ...]:
    """A line for each limit that is not kept: its flag, its value, and what was measured. Empty if all are kept."""
    found = []
    share = metrics.localised.share_of_poses
    if request.min_localised is not None and share < request.min_localised:
        found.append(f"--min-localised {request.min_localised:g}: {share:.4f} of the poses are localised")
    if request.max_ape is not None:
        if metrics.errors is None:
            reason = metrics.evaluation_error or "there is no reference to compare with"
            found.append(f"--max-ape {request.max_ape:g}: cannot be checked: {reason}")
        elif not (rmse := metrics.errors.ape.trans_part.rmse) <= request.max_ape:
            found.append(f"--max-ape {request.max_ape:g}: the RMSE of the position is {rmse:.4f} m")
    if request.max_warnings is not None and len(metrics.warnings) > request.max_warnings:
        found.append(f"--max-warnings {request.max_warnings}: there are {len(metrics.warnings)}")
    if request.fail_if is not None and metrics.verdict in _FAILING[request.fail_if]:
        found.append(f"--fail-if {request.fail_if}: the verdict is {metrics.verdict}")
    return tuple(found)
