"""A result on disk: trajectory, map, metrics, reports and a recording to look at.

Everything is written into a folder beside the target, which takes the target's name when it is complete: a run that
fails, or is interrupted, leaves nothing half-written behind.
"""

from __future__ import annotations

import csv
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hsloc.analysis.analyse import Analysis, analyse
from hsloc.analysis.map_changes import with_changes
from hsloc.analysis.metrics import run_timings
from hsloc.atomic_write import whole_folder
from hsloc.dataclass_json import to_json
from hsloc.errors import OutputError
from hsloc.evaluation import write_json, write_tum
from hsloc.export.provenance import config_text, provenance
from hsloc.export.run_mcap import LAYOUT_FILE, RunRecording, write_layout
from hsloc.garbage_collection import rarely_collected
from hsloc.maps import save_map
from hsloc.report.data import ReportParts, prepare
from hsloc.report.html import write_report_html
from hsloc.report.map_image import THUMBNAIL_FILE, draw_thumbnail
from hsloc.report.png import draw_report
from hsloc.report.view import view_of
from hsloc.slam.map_state import STATE_FILE, write_state
from hsloc.trajectory_io.tum import format_stamp, format_stamps

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from os import PathLike

    from numpy.typing import NDArray

    from hsloc.analysis.map_changes import SeenChanges
    from hsloc.localisation.states import StateRows
    from hsloc.model.estimate import Ambiguity
    from hsloc.replay.map_merge import MapMerge
    from hsloc.replay.run import Result
    from hsloc.report.view import ReportView
    from hsloc.run_metrics import RunMetrics, RunTimings

STATES_HEADER = ("t", "state", "probability", "sigma_x", "sigma_y", "sigma_theta", "fitness", "reason")
"""Columns of states.csv: what is known of each pose of trajectory.tum, line by line in its order."""
_OF_RESULTS = (("metrics.json", "config.yaml"), ("results.json", "report.md"))
"""Files that a folder of results holds, of a run or of the reproduced experiments, and no other folder."""

HYPOTHESES_HEADER = "begin,end,t,x,y,theta,probability"
"""A stretch in which several places of the map fit, and one of these, T_map_base at the stamp t."""
CHANGES_HEADER = "kind,x,y,size,cells,first,last"
"""What appeared or vanished since the map was made, and the stamps of the first and the last scan that showed it."""
COVARIANCES_HEADER = "t,xx,xy,xtheta,yy,ytheta,thetatheta"


@dataclass(frozen=True, slots=True, eq=False)
class WrittenResults:
    """What was written: the analysis of the run, its wall times, and what report.html draws."""

    analysis: Analysis
    timings: RunTimings
    view: ReportView

    def __repr__(self) -> str:
        return f"<WrittenResults: {self.analysis!r}>"

    @property
    def metrics(self) -> RunMetrics:
        """The content of metrics.json."""
        return self.analysis.metrics


def write_results(
    result: Result,
    folder: str | PathLike[str],
    *,
    overwrite: bool = False,
    progress: Callable[[float], None] | None = None,
) -> WrittenResults:
    """Analyse the result and write it into `folder`, which must not exist yet unless `overwrite`.

    Raises OutputError if the folder is there already, or cannot be written.
    """
    folder = Path(folder)
    refuse_folder(folder, overwrite)
    folder = folder.resolve()  # "." and ".." have no name of their own, and a link stays what it is
    with whole_folder(folder) as partial, rarely_collected():
        return _write(result, partial, progress)


def refuse_folder(folder: Path, overwrite: bool) -> None:
    """Raise OutputError for a folder in use; what is no folder of results is not replaced even if asked for."""
    try:
        if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
            return
        is_results = any(all((folder / name).is_file() for name in names) for names in _OF_RESULTS)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written ({error.strerror or error}); choose another --out") from error
    if not overwrite:
        raise OutputError(f"{folder}: exists already; choose another --out, or pass --overwrite")
    if not is_results:
        raise OutputError(f"{folder}: holds no results of hsloc, so it is not overwritten; choose another --out")


def _write(result: Result, folder: Path, progress: Callable[[float], None] | None) -> WrittenResults:
    begin = time.perf_counter()
    with RunRecording(result, folder / "run.mcap") as recording:
        analysis = analyse(result, observer=recording.add, progress=progress)
        recording.add_analysis(analysis)
    write_layout(folder / LAYOUT_FILE)
    seconds = {"analyse": time.perf_counter() - begin - recording.seconds, "run_mcap": recording.seconds}
    begin = time.perf_counter()
    write_tum(folder / "trajectory.tum", result.trajectory)
    if result.states is not None:
        stamps, states, changes = result.trajectory.stamps_ns, result.states, analysis.map_changes
        write_states(
            folder / "states.csv", stamps, states if changes is None else with_changes(states, stamps, changes)
        )
    if result.ambiguities:
        write_hypotheses(folder / "hypotheses.csv", result.ambiguities)
    if analysis.map_changes is not None and analysis.map_changes.changes:
        write_changes(folder / "changes.csv", analysis.map_changes)
        save_map(analysis.map_changes.layer, folder / "changes")
    if len(result.odometry):
        write_tum(folder / "odometry.tum", result.odometry)
    if result.reference is not None:
        write_tum(folder / "reference.tum", result.reference)
    if result.mode == "slam":
        save_map(result.grid, folder)
    parts = report_parts(result, analysis)
    if result.mapping is not None and parts.covariances is not None:
        write_covariances(folder / "covariances.csv", result.trajectory.stamps_ns, parts.covariances)
        result.mapping.graph.write_g2o(folder / "graph.g2o")
        if result.mapping.state is not None:
            write_state(result.mapping.state, folder / STATE_FILE)
    write_json(folder / "metrics.json", analysis.metrics.to_json())
    (folder / "config.yaml").write_text(config_text(result), encoding="utf-8")
    data = prepare(parts)
    draw_report(folder / "report.png", parts, data)
    draw_thumbnail(folder / THUMBNAIL_FILE, parts, data)
    view = view_of(parts, data)
    write_report_html(folder / "report.html", parts, view, data)
    seconds["reports"] = time.perf_counter() - begin
    timings = run_timings(result, seconds)
    write_json(folder / "timings.json", timings.to_json())
    return WrittenResults(analysis, timings, view)


def report_parts(result: Result, analysis: Analysis) -> ReportParts:
    """What the reports show of a result."""
    return ReportParts(
        title=" ".join(result.request.names()),
        trajectory=result.trajectory,
        localised=result.localised,
        odometry=analysis.odometry,
        reference=result.reference,
        grid=result.grid,
        diagnostics=result.diagnostics,
        metrics=analysis.metrics,
        comparison=analysis.comparison,
        states=None if result.states is None else tuple(str(state) for state in result.states.state),
        covariances=result.pose_covariances(),
        overlay=analysis.overlay,
        coverage=analysis.coverage,
        map_changes=analysis.map_changes,
        mapping=result.mapping,
        provenance=provenance(result),
        ambiguities=result.ambiguities,
        convergence=analysis.convergence,
    )


def write_states(path: Path, stamps_ns: NDArray[np.int64], rows: StateRows) -> None:
    """Write one line for each of the n stamps: seconds, metres and radians; nan where a figure is unknown."""
    sigma = rows.sigma.T.tolist()
    columns = (
        format_stamps(stamps_ns),
        [state.value for state in rows.state],
        map("%.4f".__mod__, rows.probability.tolist()),
        *(map(form.__mod__, column) for form, column in zip(("%.4f", "%.4f", "%.5f"), sigma, strict=True)),
        map("%.3f".__mod__, rows.fitness.tolist()),
        rows.reason,
    )
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(STATES_HEADER)
        writer.writerows(zip(*columns, strict=True))


def write_hypotheses(path: Path, ambiguities: Sequence[Ambiguity]) -> None:
    """Write one line for each place between which the run does not decide: seconds, metres and radians."""
    lines = [HYPOTHESES_HEADER]
    for each in ambiguities:
        stamps = ",".join(map(format_stamp, (each.begin_ns, each.end_ns, each.stamp_ns)))
        for pose, probability in each.places:
            lines.append(f"{stamps},{pose.x:.3f},{pose.y:.3f},{pose.theta:.4f},{probability:.4f}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_changes(path: Path, changes: SeenChanges) -> None:
    """Write one line for each change of the map, the largest first: metres and seconds."""
    lines = [CHANGES_HEADER]
    for each, span in zip(changes.changes, changes.spans_ns.tolist(), strict=True):
        stamps = ",".join(map(format_stamp, span))
        lines.append(f"{each.kind},{each.x:.3f},{each.y:.3f},{each.size:.2f},{each.cells},{stamps}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_covariances(path: Path, stamps_ns: NDArray[np.int64], covariances: NDArray[np.float64]) -> None:
    """Write one line for each of the n stamps: seconds, and the upper triangle of (n, 3, 3) in m^2, m rad and rad^2."""
    rows, columns = np.triu_indices(3)
    upper = covariances[:, rows, columns]
    lines = map(("%s" + ",%.4g" * 6).__mod__, zip(format_stamps(stamps_ns), *upper.T.tolist(), strict=True))
    path.write_text("\n".join((COVARIANCES_HEADER, *lines)) + "\n", encoding="utf-8")


def merge_summary(merge: MapMerge) -> dict[str, Any]:
    """The content of merge.json: verdict, where each map lies (m, rad), the loops that join it, the map's quality."""
    maps = [
        {"map": name, "x": pose.x, "y": pose.y, "yaw": pose.theta, "loops": joints}
        for name, pose, joints in zip(merge.names, merge.T_first_map, merge.joints, strict=True)
    ]
    return {**merge.mapping.evidence.to_dict(), "maps": maps, "mapping": to_json(merge.mapping.quality)}


def write_merged_map(merge: MapMerge, folder: Path) -> None:
    """Write map.yaml and map.pgm, map.npz to go on from, graph.g2o and merge.json. Raises OutputError."""
    state = merge.mapping.state
    with whole_folder(folder) as partial:
        save_map(merge.mapping.grid, partial)
        merge.mapping.graph.write_g2o(partial / "graph.g2o")
        if state is not None:
            write_state(state, partial / STATE_FILE)
        write_json(partial / "merge.json", merge_summary(merge))
