"""Show what is in a log, what is wrong with it, and how hsloc would read it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from hsloc.cli.arguments import add_read_arguments, read_options
from hsloc.cli.output import pose_text

if TYPE_CHECKING:
    import argparse

    from hsloc.log import Log, LogSummary, Losses

HELP = "show what is in a log"
EXAMPLES = """
  hsloc info run.mcap
  hsloc info bag_folder --quick --json
"""

YEAR_2000_NS = 946_684_800_000_000_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `hsloc info`."""
    parser.add_argument("log", nargs="+", metavar="LOG", help="Log: a file, its parts, or a folder with them.")
    add_read_arguments(parser)
    parser.add_argument("--quick", action="store_true", help="Do not read all of it in search of damage.")
    parser.add_argument("--json", action="store_true", help="Print everything as JSON.")


def run(arguments: argparse.Namespace) -> int:
    """Report; returns the exit code: 3 where part of the log is damaged."""
    from dataclasses import replace
    from json import dumps

    from hsloc.log import open_log

    # What is missing or ambiguous is what a user wants to see here.
    log = open_log(arguments.log, replace(read_options(arguments), require_scan=False, require_odometry=False))
    counts: dict[str, int] = {}
    losses = log.losses
    if not arguments.quick:
        for event in log.events():
            name = type(event).__name__.lower()
            counts[name] = counts.get(name, 0) + 1
        losses = _all_losses(log)
    report = _values(log, losses, counts)
    if arguments.json:
        print(dumps(report, indent=2))
    else:
        print("\n".join(_lines(log.summary, losses, report)))
    return 3 if losses.data_lost else 0


def _all_losses(log: Log) -> Losses:
    """Those of the events, and of what no event is made of; chunks that both met are counted once."""
    losses, everything = log.losses.copy(), log.verify()
    for name in ("damaged_chunks", "unknown_compression", "bytes_lost", "truncated_files"):
        setattr(losses, name, getattr(everything, name))
    for reason in everything.reasons:
        losses.note(reason)
    return losses


def _values(log: Log, losses: Losses, counts: dict[str, int]) -> dict[str, Any]:
    from hsloc.dataclass_json import to_json

    summary = log.summary
    grid, start = log.map(), log.initial_pose()
    pose = summary.T_base_laser
    return {
        "paths": [str(path) for path in summary.paths],
        "format": summary.format,
        "profile": summary.profile,
        "sha256": log.sha256(),
        "start_ns": summary.start_ns,
        "end_ns": summary.end_ns,
        "duration_s": summary.duration_s,
        "parts": [{"path": str(part.path), "start_ns": part.start_ns, "end_ns": part.end_ns} for part in summary.parts],
        "topics": [
            {
                "topic": topic.topic,
                "type": topic.typename,
                "encoding": topic.encoding,
                "count": topic.count,
                "rate_hz": topic.rate_hz,
                "largest_gap_s": topic.largest_gap_s,
            }
            for topic in summary.topics
        ],
        "scan_topic": summary.scan_topic,
        "odom_topic": summary.odom_topic,
        "heading_topic": summary.heading_topic,
        "truth_topic": summary.truth_topic,
        "reference_candidates": list(summary.reference_candidates),
        "frames": {"odom": summary.odom_frame, "base": summary.base_frame, "laser": summary.laser_frame},
        "laser_pose": {"x": pose.x, "y": pose.y, "yaw": pose.theta, "upside_down": summary.laser_flipped},
        "extrinsics": summary.extrinsics,
        "lasers": [laser.to_dict() for laser in summary.lasers],
        "order": summary.order,
        "map": None
        if grid is None
        else {"height": grid.cells.shape[0], "width": grid.cells.shape[1], "resolution": grid.resolution},
        "initial_pose": None
        if start is None
        else {"stamp_ns": start[0], "x": start[1].x, "y": start[1].y, "yaw": start[1].theta},
        "metadata": {name: dict(values) for name, values in summary.metadata.items()},
        "events": counts,
        "data_lost": losses.data_lost,
        "losses": losses.lines(),
        "reasons": losses.reasons,
        "warnings": [to_json(warning) for warning in summary.warnings],
    }


def _lines(summary: LogSummary, losses: Losses, report: dict[str, Any]) -> list[str]:
    """The report for people."""
    lines = [f"log:       {', '.join(report['paths'])}"]
    lines += [f"format:    {summary.format}" + (f", profile {summary.profile}" if summary.profile else "")]
    lines += [f"start:     {time_text(summary.start_ns)}", f"duration:  {summary.duration_s:.3f} s"]
    for part in summary.parts if len(summary.parts) > 1 else ():
        begin, end = ((stamp - summary.start_ns) / 1e9 for stamp in (part.start_ns, part.end_ns))
        lines += [f"part:      {begin:.3f} to {end:.3f} s: {part.path}"]
    lines += ["", "topics:"]
    lines += _table(summary)
    lines += ["", "what hsloc reads:"]
    chosen = (("scans", summary.scan_topic), ("odometry", summary.odom_topic), ("truth", summary.truth_topic))
    lines += [f"  {name + ':':<12}{topic or 'none'}" for name, topic in chosen]
    lines += [f"  {'headings:':<12}{summary.heading_topic}"] if summary.heading_topic else []
    frames = " -> ".join(name for name in (summary.odom_frame, summary.base_frame, summary.laser_frame) if name)
    lines += [f"  {'frames:':<12}{frames or 'none'}"]
    if len(summary.lasers) > 1:
        for laser in summary.lasers:
            flipped = ", upside-down" if laser.flipped else ""
            lines += [f"  {'laser:':<12}{laser.topic}: {pose_text(laser.T_base_laser)}{flipped} ({laser.extrinsics})"]
    elif summary.scan_topic is not None:
        flipped = ", upside-down" if summary.laser_flipped else ""
        lines += [f"  {'laser:':<12}{pose_text(summary.T_base_laser)}{flipped} ({summary.extrinsics})"]
    if report["map"] is not None:
        grid = report["map"]
        lines += [f"  {'map:':<12}{grid['width']} x {grid['height']} cells of {grid['resolution']} m"]
    if report["initial_pose"] is not None:
        start = report["initial_pose"]
        lines += [f"  {'start pose:':<12}x {start['x']:z.3f} m, y {start['y']:z.3f} m, yaw {start['yaw']:z.4f} rad"]
    if summary.truth_topic is None and summary.reference_candidates:
        lines += [f"  {'reference:':<12}--truth-topic could be {', '.join(summary.reference_candidates)}"]
    order = "by header stamps" if summary.order == "stamp" else "as in the log"
    lines += [f"  {'order:':<12}{order}"]
    if report["events"]:
        lines += [f"  {'events:':<12}" + ", ".join(f"{n} {name}" for name, n in sorted(report["events"].items()))]
    warnings = [*summary.warnings, *losses.lines(), *losses.reasons]
    lines += ["", "warnings:", *(f"  {warning}" for warning in warnings)] if warnings else ["", "no warnings"]
    if losses.data_lost:
        lines += ["part of the log is damaged; what is whole is read, and commands end with exit code 3"]
    return lines


def _table(summary: LogSummary) -> list[str]:
    rows = [("topic", "type", "messages", "rate", "largest gap")]
    rows += [
        (t.topic, t.typename or t.encoding, str(t.count), f"{t.rate_hz:.2f} Hz", f"{t.largest_gap_s:.3f} s")
        for t in summary.topics
    ]
    widths = [max(len(row[column]) for row in rows) for column in range(5)]
    return [
        "  "
        f"{row[0]:<{widths[0]}}  {row[1]:<{widths[1]}}  "
        + "  ".join(f"{cell:>{width}}" for cell, width in zip(row[2:], widths[2:], strict=True))
        for row in rows
    ]


def time_text(stamp_ns: int) -> str:
    """RFC 3339 for times of the calendar, decimal seconds for those of a simulation."""
    from datetime import UTC, datetime

    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    if stamp_ns < YEAR_2000_NS or seconds >= 1 << 37:
        return f"{seconds}.{nanoseconds:09d} s"
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%S") + f".{nanoseconds:09d}Z"
