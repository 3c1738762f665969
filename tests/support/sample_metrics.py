"""A RunMetrics without a run, for the tests of its readers."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from hsloc.evaluation.error_metrics import ErrorMetrics
from hsloc.evaluation.maps import Crispness, MapComparison
from hsloc.model.verdict import Verdict
from hsloc.run_metrics import (
    EvaluationCounts,
    FitnessMetrics,
    LaserMetrics,
    LocalisedMetrics,
    LogMetrics,
    LossMetrics,
    MapMetrics,
    PlanMetrics,
    ResidualMetrics,
    RunIdentity,
    RunMetrics,
    ScanCounts,
)
from hsloc.slam.result import MappingQuality, OdometryErrors

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


def mapped(metrics: RunMetrics) -> RunMetrics:
    """The same of a run that built a map, with every figure that a map can have."""
    crispness = Crispness(
        wall_thickness_median=0.209, wall_thickness_mean=0.22, wall_thickness_p95=0.39, mean_map_entropy=-2.0,
        occupancy_entropy=0.3, radius=0.3, occupied_cells=15000,
    )  # fmt: skip
    mapping = MappingQuality(
        residual_median=0.01, residual_p95=0.05, scan_rms=0.01, conflict=0.006, loops=102, loops_refused=208,
        loop_median=0.01, loop_max=0.05, loop_angle_median_deg=0.1, loop_angle_max_deg=0.5, sigma_median=0.01,
        sigma_max=0.03, sigma_angle_max_deg=0.2, keyscans=3309, followed=12, passes=3, moved=0.001,
    )  # fmt: skip
    odometry = OdometryErrors(
        translation=0.001, translation_sigma=0.001, rotation=0.005, rotation_sigma=0.004, drift=0.0, drift_sigma=0.001
    )
    plan = PlanMetrics(
        name="plan.yaml", certain=True, pose=(1.0, 2.0, 0.5), fitness=0.9, elsewhere=0.4, walls_near=0.95,
        mean_distance=0.04,
    )  # fmt: skip
    built = MapMetrics(
        residuals=ResidualMetrics(points=10000, median=0.01, p95=0.07, within_15_cm=0.976), crispness=crispness,
        mapping=mapping, comparison=MapComparison(0.9, 0.8, 0.85, 0.02, 0.03, 0.1, 900, 1000), odometry=odometry,
        plan=plan,
    )  # fmt: skip
    return replace(metrics, run=replace(metrics.run, mode="slam", map="built"), map=built)
