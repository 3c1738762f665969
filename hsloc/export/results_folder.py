"""A result on disk: trajectory, map, metrics, reports and a recording to look at.

Everything is written into a folder beside the target, which takes the target's name when it is complete: a run that
fails, or is interrupted, leaves nothing half-written behind.
"""

from __future__ import annotations

import os
import shutil
from typing import TYPE_CHECKING

from hsloc.analysis.quality_warnings import doubts
from hsloc.analysis.run_metrics import metrics, timings
from hsloc.errors import OutputError
from hsloc.evaluation import write_json, write_tum
from hsloc.export.provenance import config_text, provenance
from hsloc.export.run_mcap import write_recording
from hsloc.maps import save_map
from hsloc.report.html import write_report_html
from hsloc.report.png import draw_report
from hsloc.slam.map_state import STATE_FILE, write_state

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from hsloc.replay.run import Result

__all__ = ["metrics", "timings", "write_recording", "write_results"]

_OF_RESULTS = (("metrics.json", "config.yaml"), ("results.json", "report.md"))
"""What tells a folder of results, of a run or of the report's experiments, from anything else."""


def write_results(
    result: Result,
    folder: Path,
    *,
    overwrite: bool = False,
    alignment: str | None = None,
    relations: Path | None = None,
    progress: Callable[[float], None] | None = None,
) -> dict[str, object]:
    """Write the result into `folder`, which must not exist yet unless `overwrite`; returns the metrics.

    Raises OutputError if the folder is there already, or cannot be written.
    """
    refuse_folder(folder, overwrite)
    folder = folder.resolve()  # "." and ".." have no name of their own, and a link stays what it is
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    try:
        partial.mkdir(parents=True)
        values = _write(result, partial, alignment, relations, progress)
        if folder.exists():
            shutil.rmtree(folder)
        partial.rename(folder)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return values


def refuse_folder(folder: Path, overwrite: bool) -> None:
    """Raise OutputError for a folder in use; what is no folder of results is not replaced even if asked for."""
    try:
        if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
            return
        is_results = any(all((folder / name).is_file() for name in names) for names in _OF_RESULTS)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be read: {error.strerror or error}") from error
    if not overwrite:
        raise OutputError(f"{folder}: exists already; choose another --out, or pass --overwrite")
    if not is_results:
        raise OutputError(f"{folder}: holds no results of hsloc, so it is not overwritten; choose another --out")


def _write(
    result: Result,
    folder: Path,
    alignment: str | None,
    relations: Path | None,
    progress: Callable[[float], None] | None,
) -> dict[str, object]:
    review = write_recording(result, folder / "run.mcap", progress)
    values = metrics(result, review.residuals, alignment, relations, [*doubts(result), *review.doubts])
    write_tum(folder / "trajectory.tum", result.trajectory)
    if len(result.odometry):
        write_tum(folder / "odometry.tum", result.odometry)
    if result.reference is not None:
        write_tum(folder / "reference.tum", result.reference)
    if result.mode == "slam":
        save_map(result.grid, folder)
    if result.mapping is not None:
        result.mapping.graph.write_g2o(folder / "graph.g2o")
        if result.mapping.state is not None:
            write_state(result.mapping.state, folder / STATE_FILE)
    write_json(folder / "metrics.json", values)
    write_json(folder / "timings.json", timings(result))
    (folder / "config.yaml").write_text(config_text(result), encoding="utf-8")
    shown = {
        "title": " ".join(result.spec.names()),
        "trajectory": result.trajectory,
        "odometry": result.odometry if len(result.odometry) else None,
        "reference": result.reference,
        "grid": result.grid,
        "diagnostics": result.diagnostics,
        "metrics": values,
    }
    draw_report(folder / "report.png", **shown)  # type: ignore[arg-type]
    more = {"provenance": provenance(result), "convergence": review.convergence}
    write_report_html(folder / "report.html", **shown, **more)  # type: ignore[arg-type]
    return values
