"""metrics.json and timings.json as values: what a run measured, for every reader of it.

`RunMetrics` is built by `hsloc.analysis`, written by `hsloc.export` and read by reports, tables, sweeps and the
service. Its JSON Schema is made from the classes here (`schema`), published as docs/schemas/run-metrics.json and served
by the service at /v1/schemas/run-metrics.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from hsloc.dataclass_json import from_json, json_schema, to_json
from hsloc.errors import HslocError
from hsloc.evaluation import RelationsResult
from hsloc.evaluation.error_metrics import ErrorMetrics
from hsloc.evaluation.maps import ChangeCounts, Crispness, MapComparison
from hsloc.model.verdict import Verdict, VerdictReason
from hsloc.slam.result import MappingQuality, OdometryErrors
from hsloc.warnings import RunWarning

if TYPE_CHECKING:
    from pathlib import Path

    from hsloc.log import LaserSummary

SCHEMA_VERSION = "1.2"
"""Major number: a key was removed, renamed or changed its meaning. Minor number: a key was added."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunIdentity:
    """What was run, with which version, on which input."""

    hsloc: str
    """Version of hsloc."""
    mode: str
    """localise: on a given map; slam: a map was built."""
    inputs: tuple[str, ...]
    """Names of the logs."""
    input_sha256: str
    """SHA-256 of the logs' content."""
    map: str
    """Name of the map's file; log: the map in the log; built: a map built by this run."""
    seed: int
    """Seed of the random generator."""
    preset: str
    """Name of the preset that the configuration started from."""
    matcher: str | None
    """Scan matcher that was used; null where the mapper has its own."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LaserMetrics:
    """A laser whose scans were used, and how it is mounted."""

    topic: str
    """Topic of its scans."""
    frame: str
    """Frame of its scans."""
    x: float
    """Position of the laser in the base frame along x [m]."""
    y: float
    """Position of the laser in the base frame along y [m]."""
    yaw: float
    """Heading of the laser in the base frame [rad]."""
    upside_down: bool
    """Whether the laser is mounted upside down."""
    extrinsics: str
    """Where the mounting comes from: /tf_static, /tf, option, file format, or identity (assumed)."""

    @staticmethod
    def of(laser: LaserSummary) -> LaserMetrics:
        """Of the log's summary."""
        pose = laser.T_base_laser
        return LaserMetrics(
            topic=laser.topic,
            frame=laser.frame,
            x=pose.x,
            y=pose.y,
            yaw=pose.theta,
            upside_down=laser.flipped,
            extrinsics=laser.extrinsics,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class LogMetrics:
    """What was read of the log."""

    duration_s: float
    """Time from the first to the last pose of the trajectory [s]."""
    odometry_messages: int
    """Number of odometry messages that were used."""
    path_length_m: float
    """Length of the estimated trajectory, of the odometry where the pose is a guess [m]."""
    first_stamp_ns: int | None
    """Stamp of the first pose [ns since the epoch of the log's clock]; null without a pose."""
    odometry: str | None
    """Topic of the odometry; null where it was not used."""
    reference: str | None
    """Topic or file of the reference trajectory; null where there is none."""
    lasers: tuple[LaserMetrics, ...]
    """The lasers whose scans were used."""
    clock_offsets: tuple[ClockOffsetMetrics, ...] | None = None
    """Offsets of the clocks, by the matches of the run; left out where none was determined."""
    time_offset: str | None = None
    """Whose stamps were moved and by how much [s], as --time-offset takes it: given, or found; left out if none was."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockOffsetMetrics:
    """By how much the stamps of a laser's scans are later than those of the odometry, as their headings show."""

    topic: str
    """Topic of the scans."""
    seconds: float
    """The offset [s]; a scan with the stamp t shows the robot where the odometry has it that much before t."""
    sigma: float
    """Standard deviation of the offset [s]."""
    corrected: bool
    """Whether it was removed: from the stamps of the scans, or, where these are early, from those of the odometry."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanCounts:
    """What became of the scans. The counts by status add up to the total, those by reason too."""

    total: int
    """Number of scans."""
    used: int
    """Number of scans whose match was accepted: matched and relocalised."""
    by_status: dict[str, int]
    """Number of scans by status: matched, relocalised (pose found by search), predicted (skipped by the motion gate,
    the robot had hardly moved), rejected, no_returns, searching (during a search for the pose)."""
    by_reason: dict[str, int]
    """Number of scans by status and reason, figures left out of the reasons."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationCounts:
    """Effort of the matcher."""

    total: int
    """Number of fitness evaluations in the run."""
    median_per_match: float | None
    """Median number of fitness evaluations of a match; null without a match."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitnessMetrics:
    """Fitness of the matches, from 0 to 1."""

    median: float | None
    """Median fitness; null without a match."""
    p05: float | None
    """Fitness that 95 of 100 matches exceed; null without a match."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CertificateMetrics:
    """What was proven about the matches (docs/certificates.md)."""

    scans: int
    """Number of scans with a certificate."""
    optimal: float
    """Fraction of them for which no pose of the window is fitter by more than epsilon, from 0 to 1."""
    distinct: float
    """Fraction of them for which every other place in the window is worse by the margin, from 0 to 1."""
    median_gap: float
    """Median of the fitness by which another pose of the window may be fitter at most, from 0 to 1."""
    max_gain: float
    """Largest fitness by which a proof improved on the pose that the search found, from 0 to 1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LaserResiduals:
    """Distances from scan points to the nearest occupied cell of the map, for scans with a known pose."""

    points: int
    """Number of points that were counted."""
    median: float | None
    """Median distance [m], a multiple of 0.005 m; 0 is in the occupied cell; null without a point."""
    p95: float | None
    """Distance that 95 of 100 points stay below [m], a multiple of 0.005 m; null without a point."""
    within_15_cm: float | None = field(metadata={"key": "within_0.15_m"})
    """Fraction of the points within 0.15 m of an occupied cell, from 0 to 1; null without a point."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualMetrics(LaserResiduals):
    """Distances from scan points to the nearest occupied cell of the map, over all lasers and for each."""

    by_laser: dict[str, LaserResiduals] | None = None
    """The same for each laser frame; left out with one laser."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanMetrics:
    """Where a built map lies on the floor plan that was given, and how well it fits there."""

    name: str
    """Name of the plan's file."""
    certain: bool
    """Whether it fits at one place only, by proof; then the map and the trajectory are in the plan's frame."""
    pose: tuple[float, float, float] | None
    """Pose on the plan of the frame that the map has without it, the robot's first pose: x, y [m], yaw [rad]; null
    where it fits nowhere."""
    fitness: float
    """Mean score of the map's walls there, from 0 to 1."""
    elsewhere: float
    """Fitness that no other place of the plan exceeds, from 0 to 1."""
    walls_near: float | None
    """Fraction of the map's walls within 0.15 m of a wall of the plan, from 0 to 1; null where it is not certain."""
    mean_distance: float | None
    """Mean distance from the map's walls to the nearest wall of the plan [m]; null where it is not certain."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleMetrics:
    """Size of a given map by what the lidar measures."""

    value: float
    """Ratio of a length on the map, as it was given, to that length as the lidar measures it [m/m]."""
    sigma: float
    """Standard deviation of that ratio [m/m]."""
    resolution: float
    """Side of a cell of the map that the poses lie on [m]."""
    corrected: bool
    """Whether that is another one than in the map's file, as lidar and odometry agree."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapMetrics:
    """How well map and scans agree, and how good a map is that this run built."""

    residuals: ResidualMetrics
    """Distances from scan points to the map."""
    crispness: Crispness | None = None
    """Sharpness of the walls; only of a map that this run built."""
    mapping: MappingQuality | None = None
    """Consistency of the map and its loops; only of a map built by the graph mapper."""
    comparison: MapComparison | None = None
    """Comparison with the map in the log; only of a map that this run built, where the log has a map and truth."""
    odometry: OdometryErrors | None = None
    """Systematic errors of the odometry; only of a map built by the graph mapper with odometry, over 50 m and more."""
    plan: PlanMetrics | None = None
    """Its place on a floor plan; left out where none was given."""
    scale: ScaleMetrics | None = None
    """Its size by the lidar; only of a given map that was localised on, where the scans determine it."""
    comparison_error: str | None = None
    """Why the map was not compared with the one in the log."""
    changes: ChangeCounts | None = None
    """What changed since it was made; only of a given map that was localised on."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalisedMetrics:
    """How much of the trajectory is known."""

    share_of_poses: float
    """Fraction of the poses of the trajectory that are localised, from 0 to 1; the others are guesses."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LossMetrics:
    """What of the log could not be read."""

    data_lost: bool
    """Whether part of the input is missing from what was read; the command line then ends with exit code 3."""
    notes: tuple[str, ...]
    """One line for each kind of loss or irregular stamp, with its count."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunMetrics:
    """What a run measured. The same run gives the same bytes: wall times are in timings.json.

    The errors against the reference (`errors`) are written at the top level of the file: `ape`, `rpe_1m` and so on.
    """

    schema_version: str = SCHEMA_VERSION
    """Version of this format, major.minor: the major number rises when a key is removed, renamed or changes its
    meaning."""
    verdict: Verdict
    """Whether the result can be used: good, check (part of it may be wrong) or failed."""
    verdict_reasons: tuple[VerdictReason, ...]
    """The evidence for a verdict that is not good; empty for good."""
    run: RunIdentity
    """What was run."""
    log: LogMetrics
    """What was read of the log."""
    scans: ScanCounts
    """What became of the scans."""
    evaluations: EvaluationCounts
    """Effort of the matcher."""
    fitness: FitnessMetrics
    """Fitness of the matches."""
    map: MapMetrics
    """How well map and scans agree."""
    localised: LocalisedMetrics
    """How much of the trajectory is known."""
    losses: LossMetrics
    """What of the log could not be read."""
    warnings: tuple[RunWarning, ...]
    """Warnings about log, map and result, each with a stable code."""
    certificates: CertificateMetrics | None = None
    """Proofs about the matches; left out where none was asked for."""
    errors: ErrorMetrics | None = field(default=None, metadata={"inline": True})
    """Errors against the reference; left out without a reference."""
    evaluation_error: str | None = None
    """Why the trajectory could not be compared with the reference."""
    localised_only: ErrorMetrics | None = None
    """Errors against the reference of the localised poses alone; left out where all poses are localised."""
    localised_only_error: str | None = None
    """Why the localised poses alone could not be compared with the reference."""
    odometry_alone: ErrorMetrics | None = None
    """Errors against the reference of the odometry, moved to the trajectory's first localised pose."""
    relations: RelationsResult | None = None
    """Errors of the relations that a file states [K]; left out without such a file."""

    def to_json(self) -> dict[str, Any]:
        """The content of metrics.json."""
        result: dict[str, Any] = to_json(self)
        return result

    @staticmethod
    def from_json(values: object) -> RunMetrics:
        """From the content of metrics.json; keys of a later minor version are ignored.

        Raises HslocError for another major version, and for content that is no metrics.json.
        """
        version = values.get("schema_version") if isinstance(values, dict) else None
        if not isinstance(version, str) or version.split(".")[0] != SCHEMA_VERSION.split(".")[0]:
            found = "an earlier one" if version is None else repr(version)
            raise HslocError(f"its schema version is {found}, not {SCHEMA_VERSION}; run the replay again")
        try:
            return from_json(RunMetrics, values)
        except ValueError as error:
            raise HslocError(f"it is no metrics.json: {error}") from error

    @staticmethod
    def read(path: Path) -> RunMetrics:
        """From a file. Raises HslocError that names it."""
        try:
            return RunMetrics.from_json(json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError, HslocError) as error:
            raise HslocError(f"{path}: {error}") from error


@dataclass(frozen=True, slots=True, kw_only=True)
class RunTimings:
    """Wall times of a run: the content of timings.json, which differs from one run to the next."""

    seconds: dict[str, float]
    """Wall time by phase [s]: open, prepare (first pose, kernels), replay, finish (of a map), analyse, run_mcap,
    reports."""
    times_real_time: float | None
    """Duration of the log by the time of replay and finish; null without a duration."""
    evaluations_per_second: float | None
    """Fitness evaluations by the time of replay and finish [1/s]."""

    def to_json(self) -> dict[str, Any]:
        """The content of timings.json."""
        result: dict[str, Any] = to_json(self)
        return result

    @staticmethod
    def from_json(values: object) -> RunTimings:
        """From the content of timings.json. Raises HslocError."""
        try:
            return from_json(RunTimings, values)
        except ValueError as error:
            raise HslocError(f"it is no timings.json: {error}") from error


def schema() -> dict[str, Any]:
    """JSON Schema of metrics.json."""
    return json_schema(
        RunMetrics, f"metrics.json of hsloc, version {SCHEMA_VERSION}", f"run-metrics-{SCHEMA_VERSION}.json"
    )


def write_schemas(folder: Path) -> None:
    """Write the schema as docs/schemas has it."""
    text = json.dumps(schema(), indent=2, ensure_ascii=False) + "\n"
    (folder / "run-metrics.json").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    import sys
    from pathlib import Path

    write_schemas(Path(sys.argv[1]))
