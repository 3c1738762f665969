"""Replay many logs with many configurations and seeds, side by side; one table at the end.

Each LOG is a run of its own (a folder with the parts of a log is one). Runs that are done already, with the same
input and the same options, are not done again.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hsloc.cli.arguments import add_read_arguments, pose, read_options, to_pose
from hsloc.cli.progress import ProgressLine

if TYPE_CHECKING:
    from hsloc.config import Config
    from hsloc.sweep.runs import Outcome

HELP = "replay many logs, configurations and seeds"
PRESETS = ("default", "paper", "paper-literal")
MATCHERS = ("hide", "harmony_search", "hs", "icp")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Logs, what to vary, and how."""
    parser.add_argument("log", nargs="+", type=Path, help="logs; each is a run of its own")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of all results")
    parser.add_argument(
        "--jobs", "-j", type=_positive, default=1, metavar="N", help="runs at the same time (default: 1)"
    )
    parser.add_argument("--map", type=Path, metavar="YAML", help="map for all logs (default: /map in each)")
    parser.add_argument("--mode", choices=("auto", "localise", "slam"), default="auto")
    start = parser.add_mutually_exclusive_group()
    start.add_argument("--initial-pose", type=pose, metavar="X,Y,YAW", help="start of all runs")
    start.add_argument("--unknown-start", action="store_true", help="search the whole map")
    group = parser.add_argument_group("what to vary")
    group.add_argument("--seeds", type=seeds, default=(0,), metavar="LIST", help="such as 0,1,2 or 0-9 (default: 0)")
    group.add_argument(
        "--preset", action="append", choices=("default", "paper", "paper-literal"), help="may be repeated"
    )
    group.add_argument("--config", action="append", type=Path, metavar="FILE", help="may be repeated")
    group.add_argument("--matcher", action="append", choices=MATCHERS, help="may be repeated")
    group.add_argument(
        "--vary", action="append", default=[], metavar="KEY=V1,V2", help="a parameter, such as hide.budget=200,400"
    )
    output = parser.add_mutually_exclusive_group()
    output.add_argument("--json", action="store_true", help="print the table as JSON")
    output.add_argument("--csv", action="store_true", help="print the table as CSV")
    parser.add_argument("-q", "--quiet", action="store_true", help="print the table only")
    add_read_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Sweep; 1 where a run failed, else 3 where part of an input was lost."""
    from hsloc.cli.main import EXIT_DATA_LOST, EXIT_FAILED, EXIT_OK
    from hsloc.errors import OutputError
    from hsloc.sweep.process_pool import sweep_in_processes
    from hsloc.sweep.runs import FAILED, plan
    from hsloc.sweep.table import as_csv, as_json, as_text

    runs = plan(
        arguments.log,
        configs(arguments),
        arguments.seeds,
        map_path=arguments.map,
        read=read_options(arguments),
        initial_pose=to_pose(arguments.initial_pose),
        unknown_start=arguments.unknown_start,
        mode=arguments.mode,
    )
    folder: Path = arguments.out
    try:
        folder.mkdir(parents=True, exist_ok=True)
        done = 0
        with ProgressLine(arguments.quiet or arguments.no_progress) as line:

            def tell(outcome: Outcome) -> None:
                nonlocal done
                done += 1
                line.show("sweep", done / len(runs), f"{done} of {len(runs)} runs: {outcome.run.name} {outcome.state}")

            outcomes = sweep_in_processes(runs, folder, min(arguments.jobs, len(runs)), tell)
        (folder / "sweep.csv").write_text(as_csv(outcomes), encoding="utf-8")
        (folder / "sweep.json").write_text(as_json(outcomes), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror or error}") from error
    form = as_json if arguments.json else as_csv if arguments.csv else as_text
    sys.stdout.write(form(outcomes))
    failed = sum(outcome.state == FAILED for outcome in outcomes)
    if failed and not arguments.quiet:
        print(f"hsloc: {failed} of {len(outcomes)} runs failed", file=sys.stderr)
    if failed:
        return EXIT_FAILED
    return EXIT_DATA_LOST if any(outcome.data_lost for outcome in outcomes) else EXIT_OK


def configs(arguments: argparse.Namespace) -> dict[str, Config]:
    """All configurations by a label: presets x files x matchers x the values of --vary."""
    from dataclasses import replace

    from hsloc.config import load, preset

    found = {name: preset(name) for name in arguments.preset or ["default"]}
    if arguments.config:
        found = {_label(n, p.stem, arguments.preset): load(p, c) for n, c in found.items() for p in arguments.config}
    if arguments.matcher:
        names = list(dict.fromkeys("harmony_search" if name == "hs" else name for name in arguments.matcher))
        given = arguments.preset or arguments.config
        found = {_label(n, m, given): replace(c, matcher=m) for n, c in found.items() for m in names}
    named = bool(arguments.preset or arguments.config or arguments.matcher)
    for text in arguments.vary:
        key, values = varied(text)
        found = {
            _label(name, f"{key}={value}", named): _changed(config, key, value)
            for name, config in found.items()
            for value in values
        }
        named = True
    return found


def _label(before: str, added: str, keep: object) -> str:
    return f"{before}-{added}" if keep else added


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


def _changed(config: Config, key: str, value: Any) -> Config:
    from hsloc.config import Config, from_dict

    nested: Any = value
    for part in reversed(key.split(".")):
        nested = {part: nested}
    return from_dict(Config, nested, config, "--vary")


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
