"""Send a log to a running service; wait for the result and fetch it."""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any
from zipfile import ZipFile

from hsloc.cli.arguments import add_no_progress, add_options, add_service, service_client, values
from hsloc.cli.output import print_job
from hsloc.cli.progress import ProgressLine
from hsloc.errors import LogError, MapError
from hsloc.options import BY_NAME, MATCHER_ALIASES, merged

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Mapping


HELP = "send a log to a running service"
EXAMPLES = """
  hsloc submit run.mcap --wait
  hsloc submit rosbag2_folder --wait
  hsloc submit run.mcap --map floor.yaml --initial-pose -1,2,0 --out results/run
  hsloc submit run.mcap --mode slam --align-to plan.yaml
  hsloc submit second.mcap --resume 3f0c1a52-8f5d-4c3b-9a51-0d6f0c1d2e3f --mode slam

The token, if the service asks for one, is read from $HSLOC_TOKEN.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Where to, what, and whether to wait."""
    parser.add_argument(
        "log", nargs="+", type=Path, help="Logs: files, or folders, which are packed; several are one run."
    )
    add_service(parser)
    parser.add_argument("--wait", action="store_true", help="Wait until the job has ended; 1 unless it succeeded.")
    parser.add_argument("--out", type=Path, metavar="DIR", help="Wait, and fetch the results into this folder.")
    parser.add_argument(
        "--priority", type=int, metavar="N", help="Of your waiting jobs a higher one is begun first (default: 0)."
    )
    parser.add_argument("--tag", metavar="TAG", help="Run the job only where workers were started with this tag.")
    parser.add_argument("-q", "--quiet", action="store_true", help="Print the job's id only.")
    add_no_progress(parser)
    add_options(parser, "submit")


def run(arguments: argparse.Namespace) -> int:
    """Upload, submit, wait, fetch."""
    from hsloc.cli.main import EXIT_BELOW_LIMIT, EXIT_DATA_LOST, EXIT_FAILED, EXIT_OK

    client = service_client(arguments)
    with ProgressLine(arguments.quiet or arguments.no_progress) as line:

        def uploaded(done: int, total: int) -> None:
            line.show("upload", done / total if total else 1.0, f"{done / 1e6:.1f} MB of {total / 1e6:.1f} MB")

        request = request_of(values(arguments), client.upload)
        if arguments.priority is not None:
            request["priority"] = arguments.priority
        if arguments.tag is not None:
            request["tag"] = arguments.tag
        with TemporaryDirectory(prefix="hsloc-") as folder:
            logs = [client.upload(packed(path, Path(folder)), uploaded) for path in arguments.log]
        job = client.submit(logs, **request)
        if arguments.wait or arguments.out is not None:
            job = client.wait(job["id"], lambda now: _show(line, now))
            if job["state"] == "succeeded" and arguments.out is not None:
                client.download(job["id"], arguments.out)
    print(job["id"] if arguments.quiet else _tell(job, arguments.out))
    if job["summary"] and not arguments.quiet:
        print_job(job["summary"])
    if not (arguments.wait or arguments.out):
        return EXIT_OK
    if job["state"] != "succeeded":
        return EXIT_FAILED
    for limit in job["summary"].get("limits", ()):
        print(f"hsloc: limit not kept: {limit}", file=sys.stderr)
    if job["summary"].get("limits"):
        return EXIT_BELOW_LIMIT
    return EXIT_DATA_LOST if job["summary"]["data_lost"] else EXIT_OK


def packed(path: Path, folder: Path) -> Path:
    """A file as it is; a log of several files, a folder or a database with its write-ahead log, as a zip in `folder`.

    Raises LogError where that cannot be written.
    """
    base = path if path.is_dir() else path.parent
    if path.is_dir():
        members = sorted(each for each in path.rglob("*") if each.is_file())
    else:
        beside = (path.with_name(path.name + ending) for ending in ("-wal", "-journal"))
        members = [path, *(each for each in beside if each.is_file() and each.stat().st_size)]
        if len(members) == 1:
            return path
    target = folder / f"{path.resolve().name}.zip"
    try:
        with ZipFile(target, "w", strict_timestamps=False) as archive:  # stored: bags hardly shrink
            for member in members:
                archive.write(member, member.relative_to(base))
    except OSError as error:
        remedy = "set TMPDIR to a folder with space"
        raise LogError(f"{path}: cannot be packed for the upload ({error.strerror or error}); {remedy}") from error
    return target


def request_of(given: Mapping[str, Any], upload: Callable[[Path], str]) -> dict[str, Any]:
    """The options as the service takes them; files that they name are uploaded."""
    from hsloc.config import nested, read_values

    request: dict[str, Any] = {}
    for name, value in merged(given).items():
        option = BY_NAME[name]
        if option.is_map:
            from hsloc.maps import map_file, read_metadata

            path = map_file(value)
            if path.suffix == ".npz":
                raise MapError(f"{path}: a service takes a map as YAML and image; name the map.yaml beside it")
            image = read_metadata(path).image
            request[name] = {"yaml": upload(path), "image": upload(image)}
        elif name == "config":
            warnings: list[str] = []
            request["config"] = read_values(value, warnings)
            for line in warnings:
                print(f"hsloc: warning: {line}", file=sys.stderr)
        elif name == "resume":
            request["resume"] = str(value)
        elif name == "reference":
            merge(request, _reference(value, upload))
        elif option.kind == "path":
            request[name] = upload(value)
        elif name != "set":
            plain = ",".join(value) if option.kind == "topics" else list(value) if option.kind == "pose" else value
            (request.setdefault("read", {}) if option.place == "read" else request)[name] = plain
    if given.get("set"):
        matcher = request.get("matcher") or request.get("config", {}).get("matcher", "hide")
        merge(request.setdefault("config", {}), nested(given["set"], MATCHER_ALIASES.get(matcher, matcher)))
    return request


def _reference(text: str, upload: Callable[[Path], str]) -> dict[str, Any]:
    """A file is uploaded; a topic is one of the log."""
    from hsloc.errors import ConfigError

    if Path(text).is_file():
        return {"reference": upload(Path(text))}
    if text.lstrip("/") == "tf" or (text.startswith("/") and ":" not in text):
        return {"read": {"truth_topic": text}}
    raise ConfigError(f"--reference {text}: no such file; a service takes a TUM or CSV file, a log, or a topic")


def merge(values: dict[str, Any], changes: Mapping[str, Any]) -> None:
    """Put `changes` into `values`, tables into tables."""
    for key, change in changes.items():
        if isinstance(change, dict) and isinstance(values.get(key), dict):
            merge(values[key], change)
        else:
            values[key] = change


def _show(line: ProgressLine, job: dict[str, Any]) -> None:
    progress = job["progress"]
    if progress is None:
        line.show(job["state"], 1.0 if job["ended"] else 0.0, "")
    elif progress["phase"] == "compile":  # How many kernels there will be is not known.
        line.show_clock("compile", 20.0, progress.get("text") or "")
    else:
        line.show(progress["phase"], progress["fraction"], f"{progress['age_s']:.0f} s ago")


def _tell(job: dict[str, Any], out: Path | None) -> str:
    text = f"job {job['id']}: {job['state']}"
    if job["message"]:
        text += f" ({job['reason']}): {job['message']}"
    if out is not None and job["state"] == "succeeded":
        text += f"\nresults: {out}"
    return text
