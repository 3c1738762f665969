"""Arguments that several commands share."""

from __future__ import annotations

import argparse
import sys
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hsloc.config import Config
    from hsloc.log import ReadOptions
    from hsloc.model.pose2 import Pose2


def numbers(text: str, count: int, what: str) -> tuple[float, ...]:
    """`count` finite numbers, separated by commas or blanks."""
    try:
        values = tuple(float(part) for part in text.replace(",", " ").split())
    except ValueError:
        values = ()
    if len(values) != count or not all(isfinite(value) for value in values):
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
    return values


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


def add_read_arguments(parser: argparse.ArgumentParser) -> None:
    """How to read a log."""
    group = parser.add_argument_group("reading the log")
    group.add_argument(
        "--scan-topic", metavar="TOPIC", action="append",
        help="topic of the laser scans (default: the only one); several, or with commas, are merged",
    )  # fmt: skip
    group.add_argument("--odom-topic", metavar="TOPIC", help="topic of the odometry (default: the only one)")
    group.add_argument("--truth-topic", metavar="TOPIC", help="topic of reference poses, or tf for map -> base in /tf")
    group.add_argument("--base-frame", metavar="FRAME", help="frame of the base (default: the odometry's child frame)")
    group.add_argument(
        "--laser-pose", type=pose, metavar="X,Y,YAW", help="mounting of the laser, over what the log says"
    )
    group.add_argument(
        "--deskew", action="store_true", help="move each beam to where the robot was when it was measured"
    )
    group.add_argument("--start", type=float, metavar="S", help="begin so many seconds into the log")
    end = group.add_mutually_exclusive_group()
    end.add_argument("--end", type=float, metavar="S", help="end so many seconds into the log")
    end.add_argument("--duration", type=float, metavar="S", help="end so many seconds after --start")
    parser.add_argument("--no-progress", action="store_true", help="no bar on the terminal")


def read_options(arguments: argparse.Namespace) -> ReadOptions:
    """What `add_read_arguments` collected."""
    from hsloc.log import ReadOptions

    end = arguments.end if arguments.duration is None else (arguments.start or 0.0) + arguments.duration
    return ReadOptions(
        scan_topic=None if arguments.scan_topic is None else ",".join(arguments.scan_topic),
        odom_topic=arguments.odom_topic,
        truth_topic=arguments.truth_topic,
        base_frame=arguments.base_frame,
        laser_pose=to_pose(arguments.laser_pose),
        start_s=arguments.start,
        end_s=end,
        deskew=arguments.deskew,
    )


def add_config_arguments(parser: argparse.ArgumentParser) -> None:
    """Which algorithms, with which parameters."""
    group = parser.add_argument_group("algorithms")
    group.add_argument("--matcher", choices=("hide", "harmony_search", "hs", "icp"), help="default: hide")
    group.add_argument("--mapper", choices=("graph", "point"), help="default: graph; point is the report's SLAM")
    group.add_argument("--preset", choices=("default", "paper", "paper-literal"), default="default", help="parameters")
    group.add_argument(
        "--config", type=Path, metavar="FILE", help="parameters from YAML (also of a ROS 2 node), on top of the preset"
    )
    group.add_argument("--seed", type=seed, default=0, metavar="N", help="seed of all randomness (default: 0)")


def seed(text: str) -> int:
    """A whole number, 0 or more."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of 0 or more")
    return int(text)


def config(arguments: argparse.Namespace) -> Config:
    """What `add_config_arguments` collected: preset, then file, then flags."""
    from dataclasses import replace

    from hsloc.config import load, preset

    chosen = preset(arguments.preset)
    if arguments.config is not None:
        ignored: list[str] = []
        chosen = load(arguments.config, chosen, ignored)
        for line in ignored:
            print(f"hsloc: warning: {line}", file=sys.stderr)
    if arguments.matcher is not None:
        chosen = replace(chosen, matcher="harmony_search" if arguments.matcher == "hs" else arguments.matcher)
    if arguments.mapper is not None:
        chosen = replace(chosen, mapper=arguments.mapper)
    return chosen
