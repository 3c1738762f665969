"""What a command leaves behind: the folder of its results, the table on stdout and the warnings on stderr."""

from __future__ import annotations

import contextlib
import os
import sys
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from typing import Any

    from hsloc.model import Pose2
    from hsloc.report.table import Row
    from hsloc.run_metrics import RunMetrics, RunTimings
    from hsloc.warnings import RunWarning


def default_folder(name: str) -> Path:
    """results/<name>-<time>."""
    stamp = datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
    return Path("results") / f"{name}-{stamp}"


def import_matplotlib() -> None:
    """Import it without the docstrings that it writes for each class while it is imported: 0.1 s of each command.

    For programs only: where hsloc is a library, others may look at these docstrings.
    """
    from matplotlib import artist

    names = ((artist, "kwdoc"), (artist.Artist, "_update_set_signature_and_docstring"))
    before = [(owner, name, vars(owner)[name]) for owner, name in names if name in vars(owner)]
    for owner, name, _ in before:
        setattr(owner, name, lambda *_: "")
    try:
        import hsloc.report.png  # noqa: F401
    finally:
        for owner, name, value in before:
            setattr(owner, name, value)


def refuse_early(folder: Path, overwrite: bool) -> None:
    """Raise OutputError for a folder that cannot be written, before the work and not after it."""
    from hsloc.export.results_folder import refuse_folder

    refuse_folder(folder, overwrite)
    need_writable(folder)


def need_writable(target: Path) -> None:
    """Raise OutputError where the folder that a file or folder is to be made in cannot be written to."""
    from hsloc.errors import OutputError

    parent = target.resolve().parent
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        reason = f"{parent} is not a folder that may be written to"
        raise OutputError(f"{target}: cannot be written ({reason}); choose another --out")


def link_latest(folder: Path) -> None:
    """`results/latest` points to the newest results; without symbolic links on this system nothing is lost."""
    link = folder.parent / "latest"
    with contextlib.suppress(OSError):
        if link.is_symlink():
            link.unlink()
        link.symlink_to(folder.name, target_is_directory=True)


def print_warnings(warnings: Iterable[RunWarning]) -> None:
    """One line on stderr for each warning."""
    for warning in warnings:
        print(f"hsloc: warning: {warning}", file=sys.stderr)


def print_job(summary: Mapping[str, Any]) -> None:
    """The result of a job of the service, as `print_summary` and `print_warnings` show that of a replay."""
    from hsloc.dataclass_json import from_json
    from hsloc.model.verdict import VerdictReason
    from hsloc.report.table import Row, reason_texts
    from hsloc.warnings import RunWarning

    # A server of an earlier version sends warnings as text, and no figures.
    found = [
        RunWarning("", each) if isinstance(each, str) else from_json(RunWarning, each) for each in summary["warnings"]
    ]
    print_warnings(found)
    verdict = summary.get("metrics", {}).get("verdict")
    lines = [] if verdict is None else [f"verdict: {summary.get('verdict_text', verdict)}"]
    lines += [summary["headline"]] if "headline" in summary else []
    reasons = [from_json(VerdictReason, each) for each in summary.get("verdict_reasons", ())]
    lines += [f"  {each}" for each in reason_texts(reasons)]
    figures = summary.get("figures", ())
    rows = [Row(each["name"], tuple(each["values"]), usual=each.get("usual", "")) for each in figures]
    print_lines(lines + _table(rows))


def print_summary(metrics: RunMetrics, timings: RunTimings, folder: Path) -> None:
    """The verdict, the figures as the reports show them, how fast the run was, and where the results are."""
    print_lines(summary_lines(metrics, timings, folder))


def print_lines(lines: Iterable[str]) -> None:
    """On stdout; a terminal without the degree sign gets a question mark, not a traceback."""
    encoding = sys.stdout.encoding or "utf-8"
    for line in lines:
        print(line.encode(encoding, "replace").decode(encoding))


def summary_lines(metrics: RunMetrics, timings: RunTimings, folder: Path) -> list[str]:
    """The lines of `print_summary`."""
    from hsloc.report.summary import ResultSummary
    from hsloc.report.table import format_duration, format_length

    summary = ResultSummary.of(metrics)
    lines = [f"verdict: {summary.verdict_text}", summary.headline, *(f"  {reason}" for reason in summary.reasons)]
    lines += _table(summary.figures)
    if metrics.errors is not None:
        lines.append(
            f"compared with the reference: {metrics.errors.matched} pairs, alignment {metrics.errors.alignment}"
        )
    elif metrics.evaluation_error is not None:
        lines.append(f"no comparison with the reference: {metrics.evaluation_error}")
    lines.append(f"path {format_length(metrics.log.path_length_m)} in {format_duration(metrics.log.duration_s)}")
    if timings.times_real_time:
        work = timings.seconds["replay"] + timings.seconds.get("finish", 0.0)
        lines.append(f"replay: {work:.2f} s, {_multiple(timings.times_real_time)}x real time")
    lines.append(f"results: {folder}")
    return lines


def _multiple(value: float) -> str:
    """A whole number, or two figures where that would say 0 or 1."""
    return f"{value:.0f}" if value >= 9.5 else f"{value:.2g}"


def _table(rows: Sequence[Row]) -> list[str]:
    width = max((len(row.label) for row in rows), default=0) + 2
    lines = [f"{'':<{width}}{'translation':>12}{'rotation':>12}"] if any(len(row.values) == 2 for row in rows) else []
    for row in rows:
        values = "".join(f"{value:>12}" for value in row.values) if len(row.values) == 2 else f"  {row.values[0]}"
        lines.append(f"{row.label:<{width}}{values}" + (f"  (usual: {row.usual})" if row.usual else ""))
    return lines


def pose_text(pose: Pose2) -> str:
    """A pose for people."""
    return f"x {pose.x:z.3f} m, y {pose.y:z.3f} m, yaw {pose.theta:z.4f} rad"
