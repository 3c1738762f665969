"""Arguments that several commands share; those of a run are made from `hsloc.options`."""

from __future__ import annotations

import argparse
import os
import sys
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hsloc.options import BY_NAME, offered

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from hsloc.client import Client
    from hsloc.log import ReadOptions
    from hsloc.model.pose2 import Pose2
    from hsloc.options import Interface, Option
    from hsloc.request import RunRequest


def add_options(parser: argparse.ArgumentParser, interface: Interface, names: Iterable[str] | None = None) -> None:
    """The options that `interface` offers, or those of them in `names`, in their groups."""
    groups: dict[str, Any] = {"": parser}
    chosen = [option for option in offered(interface) if names is None or option.name in names]
    for option in chosen:
        if option.group not in groups:
            groups[option.group] = parser.add_argument_group(option.group)
        group = groups[option.group]
        if option.instead_of:
            if option.instead_of not in groups:
                groups[option.instead_of] = group.add_mutually_exclusive_group()
            group = groups[option.instead_of]
        group.add_argument(option.flag, dest=option.name, **_how(option, interface))


def _how(option: Option, interface: Interface) -> dict[str, Any]:
    """Arguments of `add_argument`."""
    how: dict[str, Any] = {"help": option.help.replace("%", "%%")}
    repeated = option.kind in ("settings", "topics") or (interface == "sweep" and option.varied)
    if option.kind == "switch":
        return {**how, "action": "store_true", "default": None}
    if repeated:
        how["action"] = "append"
    if interface == "sweep" and option.varied:
        how["help"] = how["help"].removesuffix(".") + "; may be repeated."
    if option.kind == "choice":
        return {**how, "choices": option.choices}
    types: dict[str, Callable[[str], Any]] = {"pose": pose, "path": Path, "whole": whole, "number": _number(option)}
    metavar = "X,Y,YAW" if option.kind == "pose" else option.metavar
    return {**how, "type": types.get(option.kind, str), "metavar": metavar}


def values(arguments: argparse.Namespace) -> dict[str, Any]:
    """The options that were given, by their names."""
    return {name: value for name, value in vars(arguments).items() if name in BY_NAME and value is not None}


def numbers(text: str, count: int, what: str) -> tuple[float, ...]:
    """`count` finite numbers, separated by commas or blanks."""
    try:
        found = tuple(float(part) for part in text.replace(",", " ").split())
    except ValueError:
        found = ()
    if len(found) != count or not all(isfinite(value) for value in found):
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
    return found


def pose(text: str) -> tuple[float, float, float]:
    """x,y,yaw in metres and radians."""
    x, y, yaw = numbers(text, 3, "x,y,yaw (metres, metres, radians)")
    return x, y, yaw


def to_pose(values: tuple[float, float, float] | None) -> Pose2 | None:
    """The pose that `pose` parsed."""
    if values is None:
        return None
    from hsloc.model.pose2 import Pose2, wrap_angle

    return Pose2(values[0], values[1], wrap_angle(values[2]))


def whole(text: str) -> int:
    """A whole number, 0 or more."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of 0 or more")
    return int(text)


seed = whole


def _number(option: Option) -> Callable[[str], float]:
    def number(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None
        low, high = option.least, option.most
        if not isfinite(value) or (low is not None and value < low) or (high is not None and value > high):
            bounds = "finite" if low is None else f"{low:g} or more" if high is None else f"from {low:g} to {high:g}"
            raise argparse.ArgumentTypeError(f"{text!r} must be {bounds}")
        return value

    return number


def add_read_arguments(parser: argparse.ArgumentParser) -> None:
    """How to read a log, for commands that read one without a run."""
    names = [option.name for option in offered("replay") if option.place == "read"]
    add_options(parser, "replay", names)
    add_no_progress(parser)


def add_service(parser: argparse.ArgumentParser) -> None:
    """Add `--url`, the address of a service."""
    parser.add_argument(
        "--url", default=os.environ.get("HSLOC_URL", "http://127.0.0.1:8000"),
        help="Address of the service (default: $HSLOC_URL, else http://127.0.0.1:8000).",
    )  # fmt: skip


def service_client(arguments: argparse.Namespace) -> Client:
    """A client of the service of `--url`, with the token of $HSLOC_TOKEN."""
    from hsloc.client import Client

    return Client(arguments.url, os.environ.get("HSLOC_TOKEN"))


def add_no_progress(parser: argparse._ActionsContainer) -> None:
    """Whether a bar is shown."""
    parser.add_argument("--no-progress", action="store_true", help="Show no progress bar.")


def run_request(arguments: argparse.Namespace) -> RunRequest:
    """The run that the arguments describe; warnings of a configuration file go to stderr."""
    from hsloc.request import RunRequest

    ignored: list[str] = []
    found = RunRequest.from_values(getattr(arguments, "log", ()), values(arguments), ignored)
    for line in ignored:
        print(f"hsloc: warning: {line}", file=sys.stderr)
    return found


def read_options(arguments: argparse.Namespace) -> ReadOptions:
    """What `add_read_arguments` collected."""
    from hsloc.request import RunRequest

    return RunRequest.from_values((), values(arguments)).read


CONFIG_OPTIONS = ("preset", "config", "matcher", "mapper", "set")
"""Options that decide the configuration."""
