"""Check a log: stamps, gaps, frames, ranges, odometry, damage; each finding with its remedy.

Exit code 0: nothing that spoils results; 1: errors were found; 3: the file is damaged; 4: the recording does not keep
the profile.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from hsloc.cli.arguments import add_read_arguments, read_options
from hsloc.cli.progress import ProgressLine

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping

    from hsloc.log import CheckReport, Finding, Log, ReadOptions
    from hsloc.slam.heading_offset import Offset

HELP = "check a log for what spoils results"
EXAMPLES = """
  hsloc check run.mcap
  hsloc check run.mcap --profile fleet.yaml -q
  hsloc check run.mcap --json -q || echo "see the findings"
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `hsloc check`."""
    parser.add_argument("log", nargs="+", metavar="LOG", help="Log: a file, its parts, or a folder with them.")
    add_read_arguments(parser)
    parser.add_argument(
        "--profile", type=Path, metavar="FILE",
        help="What every recording must have, a YAML file: topics, types, rates, gaps, frames, transforms, offset.",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="Print everything as JSON.")
    parser.add_argument("-q", "--quiet", action="store_true", help="Print errors and damage only.")


def run(arguments: argparse.Namespace) -> int:
    """Check; returns the exit code."""
    from dataclasses import replace

    from hsloc.cli.main import EXIT_BELOW_LIMIT
    from hsloc.log import Severity, check_log, open_log, read_profile, violations

    profile = None if arguments.profile is None else read_profile(arguments.profile)
    log = open_log(arguments.log, replace(read_options(arguments), require_scan=False, require_odometry=False))
    start, span = log.summary.start_ns, max(log.summary.end_ns - log.summary.start_ns, 1)
    with ProgressLine(arguments.quiet or arguments.json or arguments.no_progress) as line:
        report = check_log(log, lambda log_time: line.show("check", (log_time - start) / span))
    options, findings = _with_choices(read_options(arguments), log, report.findings)
    of_odometry = _of_odometry(log)
    # An offset is none where a clock was set in the middle, or to odometry that says nothing.
    unknown = report.losses.clock_steps or any(found.severity is Severity.ERROR for found in of_odometry)
    offsets = {} if unknown else _offsets(options, log)
    report = replace(report, findings=(*findings, *of_odometry, *_of_clocks(offsets)))
    seconds = {topic: offset.seconds for topic, offset in offsets.items()}
    unkept = [] if profile is None else violations(profile, log.summary, report, seconds)
    if arguments.json:
        from json import dumps

        values = _values(report, [str(path) for path in log.summary.paths], start)
        print(dumps(values if profile is None else {**values, "profile": unkept}, indent=2))
    else:
        lines = _lines(report, start, arguments.quiet) + [f"profile: {line}" for line in unkept]
        if profile is not None and not unkept and not arguments.quiet:
            lines.append("profile: kept")
        print("\n".join(lines))
    if report.has_errors:
        return 1
    if report.losses.data_lost:
        return 3
    return EXIT_BELOW_LIMIT if unkept else 0


def _with_choices(
    options: ReadOptions, log: Log, findings: tuple[Finding, ...]
) -> tuple[ReadOptions, tuple[Finding, ...]]:
    """Options and findings; of mountings that are stated twice the one that scans and odometry agree with."""
    from hsloc.errors import HslocError
    from hsloc.log import Finding, Severity
    from hsloc.slam.front_end_parameters import FrontEndParameters
    from hsloc.slam.mounting_choice import direction_warnings, with_chosen_mountings
    from hsloc.warnings import WarningCode

    paths, parameters = log.summary.paths, FrontEndParameters()
    try:
        options, chosen = with_chosen_mountings(log, paths, options, parameters)
        turned = direction_warnings(log, paths, options, parameters, stated=True)
    except HslocError:  # The reason is among the findings.
        return options, findings
    kept = [f for f in findings if not chosen or f.code != WarningCode.EXTRINSICS_RESTATED]
    more = (Finding(w.code, Severity.WARNING, "", w.text, w.remedy, 1) for w in (*chosen, *turned))
    return options, (*kept, *more)


def _of_odometry(log: Log) -> list[Finding]:
    """A finding where the odometry proves unusable, so that a run would go on without it, or stalls."""
    from hsloc.log import Finding, Severity
    from hsloc.preprocessing.odometry import OdometryWatch, UnusableOdometry
    from hsloc.preprocessing.odometry_stalls import UnstalledOdometry
    from hsloc.warnings import WarningCode

    topic = log.summary.odom_topic
    if log.summary.scan_topic is None or topic is None:
        return []
    stalls = UnstalledOdometry(OdometryWatch(log.events()), topic)
    try:
        for _ in stalls:
            pass
    except UnusableOdometry as error:
        remedy = "repair its source, or name another with --odom-topic; a run ignores it"
        text = f"the odometry cannot be used: {error}"
        return [Finding(WarningCode.ODOMETRY_UNUSABLE, Severity.ERROR, topic, text, remedy, 1)]
    return [Finding(each.code, Severity.WARNING, topic, each.text, each.remedy, 1) for each in stalls.warnings()]


def _offsets(options: ReadOptions, log: Log) -> dict[str, Offset]:
    """The offset between the stamps of scans and odometry, where the motion determines it."""
    from hsloc.errors import HslocError
    from hsloc.slam.front_end_parameters import FrontEndParameters
    from hsloc.slam.time_offset import offsets_of_log

    if log.summary.scan_topic is None or not (log.summary.odom_topic or log.summary.heading_topic):
        return {}
    try:
        return offsets_of_log(log.summary.paths, options, FrontEndParameters())
    except HslocError:  # The reason is among the findings.
        return {}


def _of_clocks(found: Mapping[str, Offset]) -> list[Finding]:
    """Findings of the offsets that are none by chance."""
    from hsloc.log import Finding, Severity
    from hsloc.slam.time_offset import clock_warnings

    return [Finding(w.code, Severity.WARNING, topic, w.text, w.remedy, 1) for topic, w in clock_warnings(found)]


def _values(report: CheckReport, paths: list[str], start_ns: int) -> dict[str, Any]:
    return {
        "paths": paths,
        "ok": not report.has_errors and not report.losses.data_lost,
        "data_lost": report.losses.data_lost,
        "messages": report.messages,
        "findings": [
            {
                "code": finding.code,
                "severity": finding.severity.value,
                "topic": finding.topic,
                "count": finding.count,
                "text": finding.text,
                "remedy": finding.remedy,
                "first": None
                if finding.first is None
                else {
                    "message": finding.first.number,
                    "stamp_ns": finding.first.stamp_ns,
                    "log_time_ns": finding.first.log_time_ns,
                    "seconds": (finding.first.log_time_ns - start_ns) / 1e9,
                },
            }
            for finding in report.findings
        ],
        "intervals": {topic: intervals.to_dict() for topic, intervals in report.intervals.items()},
        "losses": report.losses.lines(),
        "reasons": report.losses.reasons,
    }


def _lines(report: CheckReport, start_ns: int, quiet: bool) -> list[str]:
    shown = [f for f in report.findings if not quiet or f.severity.value in ("error", "damage")]
    lines = [line for finding in shown for line in _finding_lines(finding, start_ns)]
    if quiet:
        return lines
    for topic, intervals in report.intervals.items():
        values = intervals.to_dict()
        if values["usual_s"] is not None:
            span = f"from {values['shortest_s']:.3f} to {values['longest_s']:.3f} s"
            lines.append(f"{topic}: every {values['usual_s']:.3f} s, {span}")
            lines.append("  " + ", ".join(_bin(edge, count) for edge, count in values["histogram"]))
    counts = {name: sum(f.severity.value == name for f in report.findings) for name in ("damage", "error", "warning")}
    found = ", ".join(f"{n} {name}{'s' * (n > 1 and name != 'damage')}" for name, n in counts.items() if n)
    return [*lines, f"{report.messages} messages checked: {found or 'nothing wrong'}"]


def _bin(edge: float | None, count: int) -> str:
    return f"{count} longer" if edge is None else f"{count} up to {edge * 1000:g} ms"


def _finding_lines(finding: Finding, start_ns: int) -> list[str]:
    where = f"{finding.topic}: " if finding.topic else ""
    times = f" ({finding.count} times)" if finding.count > 1 else ""
    if finding.first is not None:
        seconds = (finding.first.log_time_ns - start_ns) / 1e9
        times += f", first at {seconds:.3f} s (message {finding.first.number})"
    return [f"{finding.severity.value}: {where}{finding.text}{times}", f"  remedy: {finding.remedy}"]
