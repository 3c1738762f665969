"""What a command leaves behind: the folder of its results, the table on stdout and the warnings on stderr."""

from __future__ import annotations

import contextlib
import os
import sys
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from hsloc.run_metrics import RunMetrics, RunTimings
    from hsloc.warnings import RunWarning


def default_folder(name: str) -> Path:
    """results/<name>-<time>."""
    stamp = datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
    return Path("results") / f"{name}-{stamp}"


def refuse_early(folder: Path, overwrite: bool) -> None:
    """Raise OutputError for a folder that cannot be written, before the work and not after it."""
    from hsloc.errors import OutputError
    from hsloc.export.results_folder import refuse_folder

    refuse_folder(folder, overwrite)
    parent = folder.resolve().parent
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise OutputError(f"{folder}: cannot be written: {parent} is not a folder that may be written to")


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


def print_summary(metrics: RunMetrics, timings: RunTimings, folder: Path) -> None:
    """The verdict, the figures as the reports show them, how fast the run was, and where the results are."""
    encoding = sys.stdout.encoding or "utf-8"
    for line in summary_lines(metrics, timings, folder):
        # A terminal without the degree sign gets a question mark, not a traceback.
        print(line.encode(encoding, "replace").decode(encoding))


def summary_lines(metrics: RunMetrics, timings: RunTimings, folder: Path) -> list[str]:
    """The lines of `print_summary`."""
    from hsloc.report.table import format_duration, format_length, table_rows

    lines = [f"verdict: {metrics.verdict}", *(f"  {reason.text}" for reason in metrics.verdict_reasons)]
    rows = table_rows(metrics)
    width = max(len(row.label) for row in rows) + 2
    if any(len(row.values) == 2 for row in rows):
        lines.append(f"{'':<{width}}{'translation':>12}{'rotation':>12}")
    for row in rows:
        values = "".join(f"{value:>12}" for value in row.values) if len(row.values) == 2 else f"  {row.values[0]}"
        lines.append(f"{row.label:<{width}}{values}")
    if metrics.errors is not None:
        lines.append(
            f"compared with the reference: {metrics.errors.matched} pairs, alignment {metrics.errors.alignment}"
        )
    elif metrics.evaluation_error is not None:
        lines.append(f"no comparison with the reference: {metrics.evaluation_error}")
    lines.append(f"path {format_length(metrics.log.path_length_m)} in {format_duration(metrics.log.duration_s)}")
    if timings.times_real_time:
        work = timings.seconds["replay"] + timings.seconds.get("finish", 0.0)
        lines.append(
            f"replay: {work:.2f} s, {timings.times_real_time:.0f}x real time; "
            f"with opening, analysis and reports {sum(timings.seconds.values()):.1f} s"
        )
    lines.append(f"results: {folder}")
    return lines
