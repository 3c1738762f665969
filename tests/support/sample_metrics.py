"""A RunMetrics without a run, for the tests of its readers."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from hsloc.evaluation.error_metrics import ErrorMetrics
from hsloc.model.verdict import Verdict
from hsloc.run_metrics import (
    EvaluationCounts,
    FitnessMetrics,
    LaserMetrics,
    LocalisedMetrics,
    LogMetrics,
    LossMetrics,
    MapMetrics,
    ResidualMetrics,
    RunIdentity,
    RunMetrics,
    ScanCounts,
)

if TYPE_CHECKING:
    from hsloc.evaluation import Comparison
    from hsloc.model import ScanDiagnostics


def sample_metrics(
    comparison: Comparison | None = None, diagnostics: ScanDiagnostics | None = None, **changes: Any
) -> RunMetrics:
    """On the map of a log; `changes` are fields of RunMetrics."""
    status = Counter(() if diagnostics is None else (str(each) for each in diagnostics.status))
    metrics = RunMetrics(
        verdict=Verdict.GOOD,
        verdict_reasons=(),
        run=RunIdentity(
            hsloc="0", mode="localise", inputs=("office.mcap",), input_sha256="00", map="log", seed=0, preset="default",
            matcher="hide",
        ),
        log=LogMetrics(
            duration_s=60.0, odometry_messages=1200, path_length_m=40.0, first_stamp_ns=0, odometry="/odom",
            reference="/truth",
            lasers=(
                LaserMetrics(
                    topic="/scan", frame="laser", x=0.1, y=0.0, yaw=0.0, upside_down=False, extrinsics="/tf_static"
                ),
            ),
        ),
        scans=ScanCounts(
            total=sum(status.values()), used=status["matched"] + status["relocalised"], by_status=dict(status),
            by_reason={},
        ),
        evaluations=EvaluationCounts(total=0, median_per_match=None),
        fitness=FitnessMetrics(median=None, p05=None),
        map=MapMetrics(residuals=ResidualMetrics(points=0, median=None, p95=None, within_15_cm=None)),
        localised=LocalisedMetrics(share_of_poses=1.0),
        losses=LossMetrics(data_lost=False, notes=()),
        warnings=(),
        errors=None if comparison is None else ErrorMetrics.of(comparison.evaluation()),
    )  # fmt: skip
    return replace(metrics, **changes)
