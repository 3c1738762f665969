"""Replay many logs with many configurations and seeds, side by side; one table at the end.

Each LOG is a run of its own (a folder with the parts of a log is one). Runs that are done already, with the same
input and the same options, are not done again.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hsloc.cli.arguments import add_no_progress, add_options, values
from hsloc.cli.progress import ProgressLine
from hsloc.options import BY_NAME, MATCHER_ALIASES

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from hsloc.config import Config
    from hsloc.sweep.parallel import Shard
    from hsloc.sweep.remote import RemoteLog, UrlFolder
    from hsloc.sweep.runs import Outcome, SweepRun

HELP = "replay many logs, configurations and seeds"
EXAMPLES = """
  hsloc sweep logs/*.mcap --out nightly --jobs 4 --min-localised 0.95
  hsloc sweep run.mcap --out budgets --vary hide.budget=100,200,400 --seeds 0-9
  hsloc sweep run.mcap --out compare --matcher hide --matcher icp --csv
  hsloc sweep logs/*.mcap --out nightly --shard 0/4
  hsloc sweep --merge --out nightly
  hsloc sweep logs/*.mcap --out nightly --service http://127.0.0.1:8000
  hsloc sweep 's3://bucket/logs/*.mcap' --out s3://bucket/nightly --shard 0/4
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Logs, what to vary, and how."""
    parser.add_argument(
        "log", nargs="*", type=_place,
        help="Logs, or URLs such as s3://bucket/*.mcap; each is a run of its own. With --merge: folders.",
    )  # fmt: skip
    parser.add_argument(
        "--out", type=_place, required=True, metavar="DIR",
        help="Folder of all results, or its URL, such as s3://bucket/nightly.",
    )  # fmt: skip
    parser.add_argument(
        "--jobs", "-j", type=_positive, default=1, metavar="N", help="Runs at the same time (default: 1)."
    )
    parser.add_argument(
        "--executor", type=_dask_address, metavar="URL",
        help="Do the runs on the workers of a Dask cluster, dask://HOST:PORT, which see the same folders.",
    )  # fmt: skip
    parser.add_argument(
        "--service", metavar="URL",
        help="Have the service there do the runs as jobs; --out gets the table, the service keeps the results.",
    )  # fmt: skip
    parts = parser.add_argument_group("in parts, on several machines").add_mutually_exclusive_group()
    parts.add_argument(
        "--shard", type=_shard, metavar="I/N",
        help="Do part I of N, from 0; auto/N or auto: the index of an array job of Kubernetes, Slurm or AWS Batch.",
    )  # fmt: skip
    parts.add_argument(
        "--merge", action="store_true", help="Merge the tables of all parts in --out, or in the given folders."
    )
    group = parser.add_argument_group("what to vary, besides --preset, --config, --matcher and --mapper")
    group.add_argument("--seeds", type=seeds, default=(0,), metavar="LIST", help="Seeds: 0,1,2 or 0-9 (default: 0).")
    group.add_argument(
        "--vary", action="append", default=[], metavar="KEY=V1,V2",
        help="Values of one parameter, such as hide.budget=200,400; may be repeated.",
    )  # fmt: skip
    output = parser.add_mutually_exclusive_group()
    output.add_argument("--json", action="store_true", help="Print the table as JSON.")
    output.add_argument("--csv", action="store_true", help="Print the table as CSV.")
    parser.add_argument("-q", "--quiet", action="store_true", help="Print the table only.")
    add_no_progress(parser)
    add_options(parser, "sweep")


def run(arguments: argparse.Namespace) -> int:
    """Sweep; 1 where a run failed, else 4 where one does not keep a limit, else 3 where part of an input was lost."""
    from hsloc.cli.main import EXIT_USAGE
    from hsloc.cli.output import print_lines
    from hsloc.errors import OutputError, not_written
    from hsloc.report.sweep_page import sweep_lines, sweep_page
    from hsloc.sweep.parallel import merge, write_shard
    from hsloc.sweep.table import as_csv, as_json, as_markdown, as_parquet, as_text, rows

    folder: Path | UrlFolder = arguments.out
    if not arguments.merge and not arguments.log:
        print("hsloc sweep: error: no log is given (see hsloc sweep --help)", file=sys.stderr)
        return EXIT_USAGE
    if arguments.service is not None and (arguments.merge or arguments.shard is not None):
        print("hsloc sweep: error: --service does all parts; leave out --shard and --merge", file=sys.stderr)
        return EXIT_USAGE
    if arguments.service is not None:
        table = _sweep_by_service(arguments)
    elif arguments.merge:
        table = merge(arguments.log or [folder])
    else:
        runs = _plan(arguments)
        part = runs if arguments.shard is None else arguments.shard.part(runs)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not arguments.merge and arguments.service is None:
            outcomes = _sweep(arguments, part)
            table = rows(outcomes)
        if arguments.shard is not None:
            write_shard(folder, arguments.shard, runs, outcomes)
        else:
            (folder / "sweep.csv").write_text(as_csv(table), encoding="utf-8")
            (folder / "sweep.json").write_text(as_json(table), encoding="utf-8")
            summary = sweep_lines(table)
            (folder / "sweep.md").write_text("\n".join([as_markdown(table).rstrip(), *summary, ""]), encoding="utf-8")
            (folder / "sweep.html").write_text(sweep_page(table), encoding="utf-8")
            if (content := as_parquet(table)) is not None:
                (folder / "sweep.parquet").write_bytes(content)
    except OSError as error:
        raise OutputError(not_written(folder, error)) from error
    form = as_json if arguments.json else as_csv if arguments.csv else as_text
    if form is not as_text:
        sys.stdout.write(form(table))
    else:
        print_lines([*as_text(table).splitlines(), *(() if arguments.shard is not None else summary)])
    return _exit_code(table, arguments.quiet)


def _plan(arguments: argparse.Namespace) -> list[SweepRun]:
    from hsloc.sweep.remote import UrlFolder, remote_logs
    from hsloc.sweep.runs import plan

    logs: list[Path | RemoteLog] = []
    for place in arguments.log:
        logs += remote_logs(place.url) if isinstance(place, UrlFolder) else [place]
    return plan(logs, configs(arguments), arguments.seeds, **_common(arguments))


def _common(arguments: argparse.Namespace) -> dict[str, Any]:
    """Options that are the same in all runs."""
    return {name: value for name, value in values(arguments).items() if not BY_NAME[name].varied and name != "set"}


def _sweep(arguments: argparse.Namespace, runs: list[SweepRun]) -> list[Outcome]:
    """Do the runs where the arguments say, with a line of progress."""
    from hsloc.sweep.parallel import sweep_in_processes, sweep_on_dask

    done = 0
    with ProgressLine(arguments.quiet or arguments.no_progress) as line:

        def tell(outcome: Outcome) -> None:
            nonlocal done
            done += 1
            line.show_count("sweep", done, len(runs), f"runs, last {outcome.run.name}: {outcome.state}")

        line.show_count("sweep", 0, len(runs), "runs")
        if arguments.executor is not None:
            return sweep_on_dask(runs, arguments.out, arguments.executor, tell)
        return sweep_in_processes(runs, arguments.out, max(min(arguments.jobs, len(runs)), 1), tell)


def _sweep_by_service(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Upload the logs, have a service do the runs, and wait for the table."""
    from hsloc.cli.submit import request_of
    from hsloc.client import Client
    from hsloc.config import differences, nested, preset
    from hsloc.errors import HslocError
    from hsloc.sweep.runs import DONE, FAILED

    client = Client(arguments.service, os.environ.get("HSLOC_TOKEN"))
    varied_options = {
        label: {
            "preset": base,
            "config": {**nested(differences(config, preset(base)), config.matcher), "matcher": config.matcher},
        }
        for label, (base, config) in configs(arguments).items()
    }
    for place in arguments.log:
        if not isinstance(place, Path):
            raise HslocError(f"{place}: a service takes files; leave out --service, or fetch the log first")
    with ProgressLine(arguments.quiet or arguments.no_progress) as line:
        uploads: dict[Path, str] = {}

        def upload(path: Path) -> str:
            if path not in uploads:
                uploads[path] = client.upload(path)
                line.show("upload", len(uploads) / (len(uploads) + 1), path.name)
            return uploads[path]

        run = request_of(_common(arguments), upload)
        request = {"run": run, "configs": varied_options, "seeds": list(arguments.seeds)}
        sweep = client.submit_sweep([upload(path) for path in arguments.log], **request)

        def show(now: dict[str, Any]) -> None:
            ended = sum(count for state, count in now["states"].items() if state not in ("queued", "running"))
            line.show_count("sweep", ended, now["jobs"], f"jobs of sweep {now['id']}")

        table = client.wait_sweep(sweep["id"], show)
    return [{**row, "state": DONE if row["state"] == "succeeded" else FAILED} for row in table]


def _exit_code(table: Sequence[Mapping[str, Any]], quiet: bool) -> int:
    from hsloc.cli.main import EXIT_BELOW_LIMIT, EXIT_DATA_LOST, EXIT_FAILED, EXIT_OK
    from hsloc.sweep.runs import FAILED

    failed = sum(row["state"] == FAILED for row in table)
    if failed and not quiet:
        print(f"hsloc: {failed} of {len(table)} runs failed", file=sys.stderr)
    if failed:
        return EXIT_FAILED
    if any(row["limits"] for row in table):
        return EXIT_BELOW_LIMIT
    return EXIT_DATA_LOST if any(row["data_lost"] for row in table) else EXIT_OK


def configs(arguments: argparse.Namespace) -> dict[str, tuple[str, Config]]:
    """All configurations, with their presets, by a label: presets x files x matchers x mappers x values of --vary."""
    from hsloc.config import combined, preset

    found: dict[str, tuple[str, Config]] = {name: (name, preset(name)) for name in arguments.preset or ["default"]}
    named = bool(arguments.preset)
    matchers = list(dict.fromkeys(MATCHER_ALIASES.get(name, name) for name in arguments.matcher or ()))
    mappers = list(dict.fromkeys(arguments.mapper or ()))
    variants: list[list[tuple[str, dict[str, Any]]]] = [
        [(path.stem, {"source": path}) for path in arguments.config or ()],
        [(name, {"chosen": {"matcher": name}}) for name in matchers],
        [(name, {"chosen": {"mapper": name}}) for name in mappers],
    ]
    for key, vary in map(varied, arguments.vary):
        variants.append([(f"{key}={value}", {"settings": [f"{key}={json.dumps(value)}"]}) for value in vary])
    for choices in variants:
        if choices:
            found = {
                _label(label, added, named): (base, combined(config, **change))
                for label, (base, config) in found.items()
                for added, change in choices
            }
            named = True
    settings = arguments.set or ()
    return {label: (base, combined(config, settings=settings)) for label, (base, config) in found.items()}


def _label(before: str, added: str, keep: object) -> str:
    return f"{before}-{added}" if keep else added


def _place(text: str) -> Path | UrlFolder:
    """A path, or what is at a URL."""
    if "://" not in text:
        return Path(text)
    from hsloc.sweep.remote import UrlFolder

    return UrlFolder(text)


def varied(text: str) -> tuple[str, list[Any]]:
    """Key and values of `--vary`."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    from hsloc.errors import ConfigError

    key, sign, values = text.partition("=")
    try:
        parsed = YAML(typ="safe", pure=True).load(f"[{values}]")
    except YAMLError as error:
        raise ConfigError(f"--vary {text}: the values are not valid YAML") from error
    if not sign or not key or not parsed:
        raise ConfigError(f"--vary {text}: is not KEY=V1,V2 (such as hide.budget=200,400)")
    return key, parsed


def seeds(text: str) -> tuple[int, ...]:
    """`0,1,2`, `0-9`, or both."""
    found: list[int] = []
    for part in text.split(","):
        first, sign, last = part.strip().partition("-")
        if not first.isdecimal() or (sign and not last.isdecimal()) or (sign and int(last) < int(first)):
            raise argparse.ArgumentTypeError(f"{text!r} is not a list of seeds (such as 0,1,2 or 0-9)")
        if sign and int(last) - int(first) >= 100_000:
            raise argparse.ArgumentTypeError(f"{text!r} are too many seeds")
        found += range(int(first), int(last if sign else first) + 1)
    return tuple(dict.fromkeys(found))


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of 1 or more")
    return int(text)


def _shard(text: str) -> Shard:
    from hsloc.sweep.parallel import parse_shard

    try:
        return parse_shard(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _dask_address(text: str) -> str:
    """The address of a scheduler as Dask has it."""
    scheme, sign, address = text.partition("://")
    if scheme != "dask" or not sign or ":" not in address:
        raise argparse.ArgumentTypeError(f"{text!r} is not dask://HOST:PORT")
    return f"tcp://{address}"
