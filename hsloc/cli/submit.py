"""Send a log to a running service; wait for the result and fetch it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hsloc.cli.arguments import add_read_arguments, pose, seed
from hsloc.cli.progress import ProgressLine

if TYPE_CHECKING:
    import argparse

    from hsloc.client import Client

HELP = "send a log to a running service"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Where to, what, and whether to wait."""
    parser.add_argument("log", nargs="+", type=Path, help="log, one file; several are one run")
    parser.add_argument("--url", default=os.environ.get("HSLOC_URL", "http://127.0.0.1:8000"), help="$HSLOC_URL")
    parser.add_argument("--map", type=Path, metavar="YAML", help="map as nav2 writes it (default: the log's own)")
    parser.add_argument(
        "--resume", metavar="JOB", help="extend the map of an earlier mapping job of this service: its id"
    )
    parser.add_argument("--mode", choices=("auto", "localise", "slam"), default="auto")
    parser.add_argument("--matcher", choices=("hide", "harmony_search", "icp", "exact"))
    parser.add_argument("--mapper", choices=("graph", "point"))
    parser.add_argument("--preset", choices=("default", "paper", "paper-literal"), default="default")
    parser.add_argument("--seed", type=seed, default=0, metavar="N")
    start = parser.add_mutually_exclusive_group()
    start.add_argument("--initial-pose", type=pose, metavar="X,Y,YAW", help="start, in metres and radians")
    start.add_argument("--unknown-start", action="store_true", help="search the whole map")
    parser.add_argument("--config", type=Path, metavar="FILE", help="parameters from YAML, on top of the preset")
    parser.add_argument("--no-odom", action="store_true", help="draw a map without looking at the log's odometry")
    parser.add_argument("--alignment", choices=("none", "origin", "se2"), help="as in `hsloc replay`")
    parser.add_argument(
        "--relations", type=Path, metavar="FILE", help="score by relations: `t1 t2 x y z roll pitch yaw`"
    )
    parser.add_argument("--wait", action="store_true", help="wait until the job has ended; 1 unless it succeeded")
    parser.add_argument("--out", type=Path, metavar="DIR", help="wait, and fetch the results into this folder")
    parser.add_argument("-q", "--quiet", action="store_true", help="print the job's id only")
    add_read_arguments(parser)
    parser.epilog = "The token, if the service asks for one, stands in $HSLOC_TOKEN."


def run(arguments: argparse.Namespace) -> int:
    """Upload, submit, wait, fetch."""
    from hsloc.cli.main import EXIT_DATA_LOST, EXIT_FAILED, EXIT_OK
    from hsloc.client import Client

    client = Client(arguments.url, os.environ.get("HSLOC_TOKEN"))
    with ProgressLine(arguments.quiet) as line:

        def uploaded(done: int, total: int) -> None:
            line.show("upload", done / total if total else 1.0, f"{done / 1e6:.1f} MB of {total / 1e6:.1f} MB")

        request = _request(arguments, client)
        job = client.submit([client.upload(path, uploaded) for path in arguments.log], **request)
        if arguments.wait or arguments.out is not None:
            job = client.wait(job["id"], lambda now: _show(line, now))
            if job["state"] == "succeeded" and arguments.out is not None:
                client.download(job["id"], arguments.out)
    print(job["id"] if arguments.quiet else _tell(job, arguments.out))
    if not (arguments.wait or arguments.out):
        return EXIT_OK
    if job["state"] != "succeeded":
        return EXIT_FAILED
    return EXIT_DATA_LOST if job["summary"]["data_lost"] else EXIT_OK


def _request(arguments: argparse.Namespace, client: Client) -> dict[str, Any]:
    names = ("mode", "matcher", "mapper", "preset", "seed", "unknown_start", "alignment", "resume")
    request: dict[str, Any] = {name: getattr(arguments, name) for name in names}
    request["no_odometry"] = arguments.no_odom
    request["read"] = _read(arguments)
    if arguments.initial_pose is not None:
        request["initial_pose"] = list(arguments.initial_pose)
    if arguments.config is not None:
        request["config"] = _yaml(arguments.config)
    if arguments.map is not None:
        image = arguments.map.parent / str(_yaml(arguments.map).get("image", ""))
        request["map"] = {"yaml": client.upload(arguments.map), "image": client.upload(image)}
    if arguments.relations is not None:
        request["relations"] = client.upload(arguments.relations)
    return request


def _read(arguments: argparse.Namespace) -> dict[str, Any]:
    """How to read the log, as `hsloc replay` takes it."""
    names = {"odom_topic", "truth_topic", "base_frame", "laser_pose", "deskew"}
    found: dict[str, Any] = {name: getattr(arguments, name) for name in sorted(names)}
    found |= {"start_s": arguments.start, "end_s": arguments.end}
    if arguments.scan_topic is not None:
        found["scan_topic"] = ",".join(arguments.scan_topic)
    return found


def _yaml(path: Path) -> dict[str, Any]:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    from hsloc.errors import ConfigError

    try:
        values = YAML(typ="safe", pure=True).load(path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from error
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: must be a table of keys and values")
    return values


def _show(line: ProgressLine, job: dict[str, Any]) -> None:
    progress = job["progress"]
    if progress is None:
        line.show(job["state"], 1.0 if job["ended"] else 0.0, "")
    else:
        line.show(progress["phase"], progress["fraction"], f"told {progress['age_s']:.0f} s ago")


def _tell(job: dict[str, Any], out: Path | None) -> str:
    text = f"job {job['id']}: {job['state']}"
    if job["message"]:
        text += f" ({job['reason']}): {job['message']}"
    if out is not None and job["state"] == "succeeded":
        text += f"\nresults: {out}"
    return text
