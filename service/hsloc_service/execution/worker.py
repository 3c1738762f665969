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

from hsloc_service.execution import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from hsloc.replay.run import Progress
    from hsloc.request import RunRequest

EVERY_S = 0.25
"""Progress is told this often at most."""
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT)


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

    try:
        tell({"done": execute(job, arguments.folder, _throttled(tell))})
    except MemoryError:
        tell({"failed": "out_of_memory", "message": "the job needed more memory than it is allowed"})
        return 1
    except Exception as error:
        tell(explain(error))
        traceback.print_exc()
        return 1
    return 0


def execute(job: Mapping[str, Any], folder: Path, report: Callable[[str, float, float, int], None]) -> dict[str, Any]:
    """Replay and write the results into `folder/output`; returns the summary for the job's row."""
    from hsloc.evaluation import read_relations
    from hsloc.export.results_folder import timings, write_results
    from hsloc.replay.run import run
    from hsloc_service.results.preview import write_viewer

    report("open", 0.0, 1.0, 0)
    spec = make_spec(job, folder)
    relations = None if job.get("relations") is None else folder / "relations" / job["relations"]
    if relations is not None:
        read_relations(relations)  # what cannot be read is told now, not after an hour of replay

    def replayed(progress: Progress) -> None:
        report(progress.phase, progress.done_s, progress.total_s, progress.scans)

    result = run(spec, replayed)
    # Warnings are a part of the results, which are to be the same in every folder.
    result = dataclasses.replace(result, warnings=tuple(plain_names(each) for each in result.warnings))
    scans = len(result.diagnostics)
    metrics = write_results(
        result,
        folder / "output",
        alignment=job["request"].get("alignment"),
        relations=relations,
        progress=lambda share: report("write", share, 1.0, scans),
    )
    write_viewer(result, folder / "output", metrics)
    return {
        "metrics": {
            key: metrics[key] for key in ("run", "log", "scans", "ape", "relations", "losses") if key in metrics
        },
        "data_lost": result.losses.data_lost,
        "warnings": [str(warning)[:500] for warning in result.warnings][:50],
        "notes": [line[:500] for line in result.losses.lines()][:50],
        "timings": timings(result),
    }


def make_spec(job: Mapping[str, Any], folder: Path) -> RunRequest:
    """The run that the job asks for. Raises ConfigError or MapError for what does not fit."""
    from dataclasses import replace

    from hsloc.config import Config, from_dict, preset
    from hsloc.log import ReadOptions
    from hsloc.model.pose2 import Pose2, wrap_angle
    from hsloc.request import RunRequest

    request = job["request"]
    config = from_dict(Config, request.get("config") or {}, preset(request["preset"]))
    chosen = {name: request[name] for name in ("matcher", "mapper") if request.get(name) is not None}
    config = replace(config, **chosen)
    pose = request.get("initial_pose")
    read = request.get("read") or {}
    laser = read.get("laser_pose")
    options = {key: value for key, value in read.items() if key != "laser_pose"}
    return RunRequest(
        logs=tuple(folder / place for place in job["logs"]),
        resume=None if job.get("resume") is None else folder / job["resume"],
        map_path=None if job.get("map") is None else linked_map(folder, job["map"], job["map_image"]),
        config=config,
        read=ReadOptions(
            **options, laser_pose=None if laser is None else Pose2(laser[0], laser[1], wrap_angle(laser[2]))
        ),
        initial_pose=None if pose is None else Pose2(pose[0], pose[1], wrap_angle(pose[2])),
        unknown_start=request["unknown_start"],
        seed=request["seed"],
        preset=request["preset"],
        mode=request.get("mode", "auto"),
        no_odometry=request.get("no_odometry", False),
    )


def linked_map(folder: Path, name: str, image: str) -> Path:
    """The map's YAML, with its image under the name that it asks for.

    The name must be plain: a YAML that says `image: /etc/passwd` would have us read what was not uploaded.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    from hsloc.errors import MapError

    path = folder / "map" / name
    if path.stat().st_size > 1 << 20:
        raise MapError(f"{name}: larger than 1 MiB, which no map's YAML is")
    try:
        values = YAML(typ="safe", pure=True).load(path)
        wanted = values["image"]
    except (YAMLError, UnicodeDecodeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise MapError(f"{name}: not a map's YAML with an `image`") from error
    if not isinstance(wanted, str) or wanted in ("", ".", "..") or "/" in wanted or "\0" in wanted or len(wanted) > 200:
        raise MapError(f"{name}: image is {wanted!r:.100}; it must be the plain name of a file beside the YAML")
    target = folder / "map" / wanted
    if not target.exists():
        target.symlink_to(folder / "map" / image)
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
    return re.sub(rf"{re.escape(str(Path.cwd()))}/(?:(?:input(?:-\d+)?|map|relations|output)/)?", "", text)


def _throttled(tell: Callable[[dict[str, Any]], None]) -> Callable[[str, float, float, int], None]:
    last, phase = 0.0, ""

    def report(now_in: str, done: float, total: float, scans: int) -> None:
        nonlocal last, phase
        now = time.monotonic()
        if now - last >= EVERY_S or now_in != phase:
            last, phase = now, now_in
            tell({"phase": now_in, "part": done, "total": total, "scans": scans})

    return report


if __name__ == "__main__":
    sys.exit(main())
