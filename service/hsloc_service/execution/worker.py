"""The process of one job: `python -m hsloc_service.execution.worker FOLDER --fd N --parent PID`.

It has no database and no token: a folder with `job.json` and the input, and a pipe for progress as JSON lines. It calls
the same `hsloc.replay.run` as the command line. Whatever an upload holds is parsed here, under the limits.
"""

from __future__ import annotations

import argparse
import dataclasses
import errno
import json
import os
import re
import sys
import time
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hsloc.options import BY_NAME
from hsloc_service.execution import limits
from hsloc_service.stored_request import MAPS, UPLOADS

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from hsloc.replay.progress import Progress
    from hsloc.report.view import ReportView
    from hsloc.request import RunRequest
    from hsloc.run_metrics import RunMetrics, RunTimings

EVERY_S = 0.25
"""Shortest time between two lines of progress [s]."""
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
_SUMMARISED = ("verdict", "run", "log", "scans", "localised", "ape", "relations", "losses")
"""Keys of metrics.json that the job's row holds, too."""
_MOST_LINES = 50
_PICTURE = "viewer-map.png"


def main(argv: list[str] | None = None) -> int:
    """Run the job; the exit code is 0 exactly if the last line of the pipe says `done`."""
    parser = argparse.ArgumentParser(prog="hsloc_service.execution.worker")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--fd", type=int, required=True)
    parser.add_argument("--parent", type=int, required=True)
    arguments = parser.parse_args(argv)
    job = json.loads((arguments.folder / "job.json").read_text(encoding="utf-8"))
    limits.apply(job["limits"], arguments.parent)

    def tell(line: dict[str, Any]) -> None:
        os.write(arguments.fd, json.dumps(line).encode() + b"\n")

    begin = time.monotonic()

    def say(text: str) -> None:
        sys.stdout.write(f"{time.monotonic() - begin:7.1f} s  {plain_names(text)}\n")  # it is not buffered

    try:
        if job["request"].get("inspect"):
            tell({"done": inspect(job, arguments.folder)})
        else:
            tell({"done": execute(job, arguments.folder, _throttled(tell, say), say)})
    except MemoryError:
        tell({"failed": "out_of_memory", "message": "the job needed more memory than it is allowed"})
        return 1
    except Exception as error:
        told = explain(error)
        tell(told)
        if told["failed"] == "internal_error":
            traceback.print_exc()
        else:
            say(f"{told['failed']}: {told['message']}")
        return 1
    return 0


CHECKED_BYTES = 1 << 30
"""Logs up to this size are checked before they are run [B]; larger ones would take minutes."""
_SEEN_TOPICS, _SEEN_FINDINGS = 300, 30


def inspect(job: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """What is in the log of the job, what is wrong with it, and what its map looks like; nothing is run."""
    import numpy as np

    from hsloc.log import check_log, open_log
    from hsloc.maps import read_map
    from hsloc.model.trajectory import Trajectory
    from hsloc.report.data import ReportParts
    from hsloc.report.view import view_of

    request = make_request(job, folder)
    log = open_log(request.logs, dataclasses.replace(request.reading(), require_scan=False, require_odometry=False))
    summary, start = log.summary, log.initial_pose()
    grid = log.map() if request.map_path is None else read_map(request.map_path).grid
    output = folder / "output"
    output.mkdir()
    if grid is not None:
        nowhere = Trajectory(np.zeros(0, np.int64), np.zeros((0, 3)))
        write_viewer(view_of(ReportParts(title="", trajectory=nowhere, grid=grid)), output)
    findings = None
    if sum(path.stat().st_size for path in request.logs) <= CHECKED_BYTES:
        findings = [
            {"severity": each.severity.value, "topic": each.topic, "count": each.count}
            | {"text": plain_names(each.text)[:500], "remedy": each.remedy[:500]}
            for each in check_log(log).findings[:_SEEN_FINDINGS]
        ]
    return {
        "format": summary.format,
        "duration_s": summary.duration_s,
        "topics": [
            {"topic": each.topic[:200], "type": each.typename[:200], "count": each.count, "rate_hz": each.rate_hz}
            for each in summary.topics[:_SEEN_TOPICS]
        ],
        "scan_topic": summary.scan_topic,
        "odom_topic": summary.odom_topic,
        "truth_topic": summary.truth_topic,
        "initial_pose": None if start is None else [start[1].x, start[1].y, start[1].theta],
        "findings": findings,
        "warnings": [plain_names(str(each))[:500] for each in summary.warnings[:_SEEN_FINDINGS]],
    }


def execute(
    job: Mapping[str, Any],
    folder: Path,
    report: Callable[[str, float, float, int], None],
    say: Callable[[str], None] = lambda _text: None,
) -> dict[str, Any]:
    """Replay and write the results into `folder/output`; returns the summary for the job's row.

    `say` gets the lines of the job's log, which its page shows.
    """
    from hsloc.analysis.quality import exceeded_limits
    from hsloc.evaluation import read_relations
    from hsloc.export.results_folder import write_results
    from hsloc.replay.run import run
    from hsloc.report.map_image import THUMBNAIL_FILE

    report("open", 0.0, 1.0, 0)
    request = make_request(job, folder)
    if request.relations is not None:
        read_relations(request.relations)  # what cannot be read is reported now, not after an hour of replay

    def replayed(progress: Progress) -> None:
        report(progress.phase, progress.done_s, progress.total_s, progress.scans)

    result = run(request, replayed)
    # Warnings are a part of the results, which are to be the same in every folder.
    plain = tuple(dataclasses.replace(each, text=plain_names(each.text)) for each in result.warnings)
    result = dataclasses.replace(result, warnings=plain)
    scans = len(result.diagnostics)
    say(f"{scans} scans, {len(result.trajectory)} poses")
    written = write_results(
        result,
        folder / "output",
        progress=lambda share: report("write", share, 1.0, scans),
    )
    write_viewer(written.view, folder / "output")
    for warning in written.metrics.warnings:
        say(f"warning: {warning}")
    say(f"verdict: {written.metrics.verdict}")
    limits = exceeded_limits(request, written.metrics)
    found: dict[str, Any] = {
        "outcome": "below_threshold" if limits else "ok",
        "limits": [line[:500] for line in limits],
    }
    found["thumbnail"] = THUMBNAIL_FILE
    return found | summarise(written.metrics, written.timings) | {"run": written.view.values["run"]}


def summarise(metrics: RunMetrics, timings: RunTimings) -> dict[str, Any]:
    """The summary of a job: the figures as the reports show them, the verdict, and all warnings of the run."""
    from hsloc.dataclass_json import to_json
    from hsloc.report.summary import ResultSummary
    from hsloc.sweep.table import figures

    values, summary = metrics.to_json(), ResultSummary.of(metrics)
    return {
        "metrics": {key: values[key] for key in _SUMMARISED if key in values},
        "headline": summary.headline,
        "verdict_text": summary.verdict_text,
        "key_figures": [row.label for row in summary.key_figures],
        "figures": [
            {"name": row.label, "values": list(row.values), "numbers": list(row.numbers), "usual": row.usual}
            for row in summary.figures
        ],
        "verdict_reasons": [
            {**_shortened(to_json(each)), "line": line[:500]}
            for each, line in zip(metrics.verdict_reasons, summary.reasons, strict=True)
        ][:_MOST_LINES],
        "data_lost": metrics.losses.data_lost,
        "warnings": [_shortened(to_json(each)) for each in metrics.warnings][:_MOST_LINES],
        "notes": [line[:500] for line in metrics.losses.notes][:_MOST_LINES],
        "timings": timings.to_json(),
        "row": figures(metrics, timings),
    }


def _shortened(values: dict[str, Any]) -> dict[str, Any]:
    """Texts of at most 500 letters, lists of at most 50 entries: the row of a job stays small."""
    return {
        key: value[:500] if isinstance(value, str) else value[:_MOST_LINES] if isinstance(value, list) else value
        for key, value in values.items()
    }


def make_request(job: Mapping[str, Any], folder: Path) -> RunRequest:
    """The run that the job asks for. Raises ConfigError or MapError for what does not fit."""
    from hsloc.request import RunRequest

    wanted = job["request"]
    values = {name: wanted.get(name) for name in BY_NAME if name not in (*MAPS, "resume")} | (wanted.get("read") or {})
    values |= {name: folder / name / job[name] for name in UPLOADS if job.get(name)}
    values |= {name: linked_map(folder / name, job[name], job[f"{name}_image"]) for name in MAPS if job.get(name)}
    if job.get("resume") is not None:
        values["map" if wanted.get("mode") == "localise" else "resume"] = folder / job["resume"]
    return RunRequest.from_values([folder / place for place in job["logs"]], {**values, "bare_names": True})


def linked_map(folder: Path, name: str, image: str) -> Path:
    """The map's YAML in a folder, with its image under the name that it asks for.

    Of a path the last name counts: a YAML that says `image: /etc/passwd` must not have us read what was not uploaded.
    """
    from hsloc.errors import MapError
    from hsloc.maps import load_yaml

    path = folder / name
    values = load_yaml(path)
    wanted = values.get("image")
    plain = wanted.replace("\\", "/").rpartition("/")[2] if isinstance(wanted, str) else ""
    if plain in ("", ".", "..") or "\0" in plain or len(plain) > 200:
        raise MapError(f"{name}: image is {wanted!r:.100}; it must name a file")
    if plain != wanted:
        # The path is of another machine: the image is the one that was uploaded, never a file of this machine.
        from ruamel.yaml import YAML

        values["image"] = plain
        path.unlink()
        with path.open("w", encoding="utf-8") as file:
            YAML(typ="safe", pure=True).dump(values, file)
    target = folder / plain
    if not target.exists():
        target.symlink_to(folder / image)
    return path


def explain(error: Exception) -> dict[str, Any]:
    """A word and a sentence for whatever ended the run."""
    from hsloc.errors import HslocError

    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError):
            return {"failed": "out_of_memory", "message": "the job needed more memory than it is allowed"}
        if isinstance(cause, OSError) and cause.errno == errno.EFBIG:
            return {"failed": "output_limit", "message": "the job wrote more than it is allowed"}
        if isinstance(cause, OSError) and cause.errno in _DISK_FULL:
            return {"failed": "disk_full", "message": "the server's disk became full while the job ran"}
        cause = cause.__cause__
    if isinstance(error, HslocError):
        message = plain_names(str(error))
        return {"failed": "invalid_input", "message": message[:2000]}
    return {"failed": "internal_error", "message": f"{type(error).__name__}: {error}"[:2000]}


def plain_names(text: str) -> str:
    """A message with the files' own names: the folder is the server's business, and differs from run to run."""
    folders = "|".join((r"input(?:-\d+)?", "output", *MAPS, *UPLOADS))
    return re.sub(rf"{re.escape(str(Path.cwd()))}/(?:(?:{folders})/)?", "", text)


def _throttled(
    tell: Callable[[dict[str, Any]], None], say: Callable[[str], None]
) -> Callable[[str, float, float, int], None]:
    """Progress for the pipe at most every `EVERY_S`, and for the log each phase and each tenth of the replay."""
    from hsloc.replay.progress import COMPILING

    last, phase, tenth, told = 0.0, "", 0, False

    def report(now_in: str, done: float, total: float, scans: int) -> None:
        nonlocal last, phase, tenth, told
        now = time.monotonic()
        if now_in != phase:
            explained = now_in == "compile" and not told  # kernels that are met later interrupt the replay again
            say(f"compile: {COMPILING}" if explained else now_in)
            told |= explained
            tenth = 0
        if now_in == "replay" and total > 0.0 and int(10.0 * done / total) > tenth:
            tenth = int(10.0 * done / total)
            say(f"replay: {10 * tenth} %, {done:.0f} of {total:.0f} s, {scans} scans")
        if now - last >= EVERY_S or now_in != phase:
            last, phase = now, now_in
            tell({"phase": now_in, "part": done, "total": total, "scans": scans})

    return report


def write_viewer(view: ReportView, folder: Path) -> None:
    """Write `viewer.json` and, where the map has a known cell, its picture `viewer-map.png`."""
    if view.map_png is not None:
        (folder / _PICTURE).write_bytes(view.map_png)
    text = json.dumps(view.with_picture(_PICTURE), separators=(",", ":"), allow_nan=False)
    (folder / "viewer.json").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
