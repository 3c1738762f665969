"""A result on disk: trajectory, metrics, picture and a recording to look at.

Everything is written into a folder beside the target, which takes the target's name when it is complete: a run that
fails, or is interrupted, leaves nothing half-written behind.
"""

from __future__ import annotations

import os
import platform
import shlex
import shutil
from collections import Counter
from importlib import metadata
from typing import TYPE_CHECKING

import numpy as np

from hsloc import __version__
from hsloc.config import dump
from hsloc.errors import EvaluationError, OutputError
from hsloc.evaluation import evaluate, write_json, write_tum
from hsloc.evaluation.report_html import Provenance, write_report_html
from hsloc.evaluation.report_png import draw_report
from hsloc.log.reader import open_log
from hsloc.log.writer import LogWriter
from hsloc.model.events import Odometry, PairedScan
from hsloc.model.pose2 import Pose2
from hsloc.model.trajectory import Trajectory
from hsloc.replay.engine import pair
from hsloc.replay.residuals import Residuals

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from hsloc.replay.run import Result, RunSpec

_PATH_POSES = 2000
"""A path to look at needs no more poses; viewers slow down."""


def write_results(
    result: Result,
    folder: Path,
    *,
    overwrite: bool = False,
    alignment: str = "none",
    progress: Callable[[float], None] | None = None,
) -> dict[str, object]:
    """Write the result into `folder`, which must not exist yet unless `overwrite`; returns the metrics.

    Raises OutputError if the folder is there already, or cannot be written.
    """
    if folder.exists() and not overwrite and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(f"{folder}: exists already; choose another --out, or pass --overwrite")
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    try:
        partial.mkdir(parents=True)
        values = _write(result, partial, alignment, progress)
        if folder.exists():
            shutil.rmtree(folder)
        partial.rename(folder)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return values


def _write(result: Result, folder: Path, alignment: str, progress: Callable[[float], None] | None) -> dict[str, object]:
    residuals = write_recording(result, folder / "run.mcap", progress)
    values = metrics(result, residuals, alignment)
    write_tum(folder / "trajectory.tum", result.trajectory)
    write_tum(folder / "odometry.tum", result.odometry)
    if result.reference is not None:
        write_tum(folder / "reference.tum", result.reference)
    write_json(folder / "metrics.json", values)
    write_json(folder / "timings.json", timings(result))
    (folder / "config.yaml").write_text(_config_text(result), encoding="utf-8")
    shown = {
        "title": " ".join(result.spec.names()),
        "trajectory": result.trajectory,
        "odometry": result.odometry,
        "reference": result.reference,
        "grid": result.grid,
        "diagnostics": result.diagnostics,
        "metrics": values,
    }
    draw_report(folder / "report.png", **shown)  # type: ignore[arg-type]
    write_report_html(folder / "report.html", **shown, provenance=_provenance(result))  # type: ignore[arg-type]
    return values


def _provenance(result: Result) -> Provenance:
    """What it takes to run it again: command, configuration, versions, checksum."""
    packages = ("numpy", "scipy", "numba", "mcap", "rosbags")
    versions = {"hsloc": __version__, "Python": platform.python_version()}
    versions |= {name: metadata.version(name) for name in packages}
    hashes = {" ".join(result.spec.names()): result.input_sha256}
    return Provenance(_command(result.spec), dump(result.spec.config), versions, hashes)


def _command(spec: RunSpec) -> str:
    """The command line that repeats the run."""
    words = ["hsloc", "replay", *spec.names()]
    if spec.map_path is not None:
        words += ["--map", spec.map_path.name]
    if spec.initial_pose is not None:
        pose = spec.initial_pose
        words.append(f"--initial-pose={pose.x!r},{pose.y!r},{pose.theta!r}")
    if spec.unknown_start:
        words.append("--unknown-start")
    read = spec.read
    for flag, value in (
        ("--scan-topic", read.scan_topic),
        ("--odom-topic", read.odom_topic),
        ("--truth-topic", read.truth_topic),
        ("--base-frame", read.base_frame),
        ("--start", read.start_s),
        ("--end", read.end_s),
    ):
        if value is not None:
            words += [flag, str(value)]
    if read.laser_pose is not None:
        mounting = read.laser_pose
        words.append(f"--laser-pose={mounting.x!r},{mounting.y!r},{mounting.theta!r}")
    return shlex.join([*words, "--config", "config.yaml", "--seed", str(spec.seed)])


def metrics(result: Result, residuals: Residuals, alignment: str = "none") -> dict[str, object]:
    """The content of metrics.json: the same for the same run, wall times left out."""
    diagnostics = result.diagnostics
    status = Counter(diagnostics.status)
    reasons = Counter(
        f"{s}: {_kind(r)}" if r else s for s, r in zip(diagnostics.status, diagnostics.reason, strict=True)
    )
    fitness = diagnostics.fitness[np.isfinite(diagnostics.fitness)]
    values: dict[str, object] = {
        "run": {
            "hsloc": __version__,
            "inputs": list(result.spec.names()),
            "input_sha256": result.input_sha256,
            "map": "log" if result.spec.map_path is None else result.spec.map_path.name,
            "seed": result.spec.seed,
            "preset": result.spec.preset,
            "matcher": result.spec.config.matcher,
        },
        "log": {
            "duration_s": _duration(result),
            "odometry_messages": len(result.odometry),
            "path_length_m": result.trajectory.length(),
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
        "map": {"residuals": residuals.to_dict()},
        "localised": {"share_of_odometry": float(result.localised.mean()) if len(result.localised) else 0.0},
        "losses": {"data_lost": result.losses.data_lost, "notes": result.losses.lines()},
        "warnings": list(result.warnings),
    }
    if result.reference is not None and len(result.reference) > 1:
        values |= _against(result.trajectory, result.reference, alignment)
        if not result.localised.all() and result.localised.any():
            believed = Trajectory(
                result.trajectory.stamps_ns[result.localised], result.trajectory.poses[result.localised]
            )
            values["localised_only"] = _against(believed, result.reference, alignment)
    return values


def _against(trajectory: Trajectory, reference: Trajectory, alignment: str) -> dict[str, object]:
    try:
        return evaluate(trajectory, reference, alignment=alignment).to_dict()
    except EvaluationError as error:
        return {"evaluation_error": str(error)}


def _kind(reason: str) -> str:
    """A reason without its figures, so that reasons can be counted."""
    return " ".join(word for word in reason.split() if not any(c.isdigit() for c in word)).rstrip(",")


def _median(values: NDArray[np.float64] | NDArray[np.int64]) -> float | None:
    return float(np.median(values)) if len(values) else None


def _duration(result: Result) -> float:
    stamps = result.odometry.stamps_ns
    return float(stamps.max() - stamps.min()) / 1e9 if len(stamps) else 0.0


def timings(result: Result) -> dict[str, object]:
    """Wall times: what differs from one run to the next."""
    replay = result.seconds["replay"]
    return {
        "seconds": result.seconds,
        "times_real_time": _duration(result) / replay if replay > 0.0 else None,
        "evaluations_per_second": int(result.diagnostics.evaluations.sum()) / replay if replay > 0.0 else None,
    }


def _config_text(result: Result) -> str:
    """The effective configuration; what else is needed to repeat the run stands above it."""
    spec = result.spec
    lines = [
        f"# hsloc {__version__}; run it again with: {_command(spec)}",
        f"# preset: {spec.preset}",
        f"# input sha256: {result.input_sha256}",
    ]
    return "\n".join(lines) + "\n" + dump(spec.config)


def write_recording(result: Result, path: Path, progress: Callable[[float], None] | None = None) -> Residuals:
    """An MCAP that viewers show without set-up: map, scans, odometry, transforms, poses and the path.

    The scans come from the log, read once more, so that memory does not grow with it; on the way their points are
    compared with the map.
    """
    log = open_log(result.spec.logs, result.spec.read)
    residuals = Residuals(result.grid)
    stamps = result.odometry.stamps_ns
    start = int(stamps[0])
    mountings: dict[str, Pose2] = {}
    row = -1
    with LogWriter(path) as writer:
        writer.metadata("hsloc", {"version": __version__, "seed": str(result.spec.seed)})
        writer.attachment("config.yaml", _config_text(result).encode(), "application/yaml")
        writer.occupancy_grid(result.grid, start)
        for event in pair(log.events()):
            if isinstance(event, PairedScan):
                scan = event.scan
                if scan.frame_id not in mountings:
                    mountings[scan.frame_id] = scan.T_base_laser
                    writer.transforms(start, [("base_link", scan.frame_id, scan.T_base_laser)], static=True)
                writer.scan(scan)
                k = max(row, 0)
                if result.localised[k]:
                    residuals.add(scan, _T_map_odom(result, k) @ event.T_odom_base)
            elif isinstance(event, Odometry):
                row += 1
                _write_pose(writer, result, row)
                if progress is not None and row % 500 == 0:
                    progress(row / len(stamps))
        every = max(len(stamps) // _PATH_POSES, 1)
        writer.path(start, Trajectory(result.trajectory.stamps_ns[::every], result.trajectory.poses[::every]))
    return residuals


def _T_map_odom(result: Result, row: int) -> Pose2:
    return Pose2(*result.trajectory.poses[row]) @ Pose2(*result.odometry.poses[row]).inverse()


def _write_pose(writer: LogWriter, result: Result, row: int) -> None:
    stamp = int(result.odometry.stamps_ns[row])
    T_odom_base = Pose2(*result.odometry.poses[row])
    transforms = [("map", "odom", _T_map_odom(result, row)), ("odom", "base_link", T_odom_base)]
    writer.transforms(stamp, transforms)
    writer.pose(stamp, Pose2(*result.trajectory.poses[row]))
