"""References as users name them: a TUM or CSV file, another log, or a topic or two frames of one.

reference.tum   reference.csv       poses as lines of text
truth.mcap                          the poses of a log, if it is clear which
truth.mcap:/vicon/pose              a topic of a log: Odometry, PoseStamped, PoseWithCovarianceStamped
truth.mcap:/tf:map.base_link        a frame's pose in another, from all transforms of a log (evo's way to name it)
/vicon/pose   /tf:map.base_link     the same of the log that is replayed
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hsloc.errors import EvaluationError, HslocError
from hsloc.log import TF, TF_NAMES, FrameTree, ReadOptions, is_log, is_static_topic, open_log
from hsloc.model import Odometry, Pose2, Trajectory, Truth
from hsloc.trajectory_io.reader import read_trajectory

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from hsloc.log import LinkMessage, Log
    from hsloc.warnings import RunWarning

    Stamped = tuple[int, Pose2]

_OF_FILES = (".tum", ".csv", ".txt", ".gz", ".mcap", ".bag", ".db3")
"""Names of topics do not end like this: who writes it means a file."""
_ANY = ReadOptions(require_scan=False, require_odometry=False)


def read_reference(text: str, logs: Sequence[Path] = (), warnings: list[RunWarning] | None = None) -> Trajectory:
    """The poses that `text` names, see above; topics alone are those of `logs`.

    What there is to know of how a file was read is added to `warnings`.

    Raises EvaluationError, or the LogError of a log that cannot be read.
    """
    path, topic = _split(text)
    if path is None:
        if not logs:
            raise EvaluationError(f"{text}: no such file; a topic needs a log: LOG:{text}")
        return _of_log(text, logs, topic)
    if topic is None and not is_log(path):
        loaded = read_trajectory(path)
        if warnings is not None:
            warnings += loaded.warnings
        return loaded.trajectory
    return _of_log(text, (path,), topic)


def _split(text: str) -> tuple[Path | None, str | None]:
    """(file, topic): either may be missing."""
    if text and Path(text).exists():
        return Path(text), None
    at = text.find(":")
    while at > 0:
        if Path(text[:at]).exists():
            return Path(text[:at]), text[at + 1 :]
        at = text.find(":", at + 1)
    if (text in TF_NAMES or text.startswith("/")) and Path(text).suffix not in _OF_FILES:
        return None, text
    raise EvaluationError(
        f"{text or repr(text)}: no such file; a reference is a TUM or CSV file, a LOG, LOG:TOPIC, or a topic"
    )


def _of_log(text: str, logs: Sequence[Path], topic: str | None) -> Trajectory:
    try:
        log = open_log(logs, _ANY)
        found = sorted(_poses(logs, log, topic), key=lambda entry: entry[0])
    except HslocError as error:
        raise type(error)(f"reference {text}: {error}") from error
    if not found:
        raise EvaluationError(f"reference {text}: no pose in the log; {_candidates(log)}")
    return Trajectory(
        np.array([stamp for stamp, _ in found], dtype=np.int64),
        np.array([(pose.x, pose.y, pose.theta) for _, pose in found], dtype=np.float64).reshape(-1, 3),
    )


def _poses(logs: Sequence[Path], log: Log, topic: str | None) -> Iterator[Stamped]:
    summary = log.summary
    if topic is None:
        topic = summary.truth_topic
        if topic is None:
            poses = [name for name in summary.reference_candidates if name not in TF_NAMES]
            if len(poses) != 1:
                raise EvaluationError(f"which poses of the log? {_candidates(log)}")
            (topic,) = poses
    frames = topic.lstrip("/").removeprefix("tf:")
    if frames != topic.lstrip("/"):
        parent, dot, child = frames.lstrip("/").partition(".")
        if not dot or not parent or not child:
            raise EvaluationError("transforms are named /tf:PARENT.CHILD, as in /tf:map.base_link")
        return _between(log, parent, child.lstrip("/"))
    if summary.odom_topic is not None and summary.odom_topic.lstrip("/") == topic.lstrip("/") != "tf":
        return ((e.stamp_ns, e.T_odom_base) for e in log.events() if isinstance(e, Odometry))
    named = open_log(logs, ReadOptions(truth_topic=topic, require_scan=False, require_odometry=False))
    return ((e.stamp_ns, e.T_map_base) for e in named.events() if isinstance(e, Truth))


def _between(log: Log, parent: str, child: str) -> Iterator[Stamped]:
    """Poses of a frame in another at the stamps of the moving transform nearest to it, the others being the latest.

    At those alone: localisers stamp map -> odom ahead of time. Static transforms hold for the whole log.
    """
    tree, known = FrameTree(), FrameTree()
    moving: set[str] = set()
    for _, link, is_static in _links(log):
        known.add(link.parent, link.child, link.transform)
        if is_static:
            tree.add(link.parent, link.child, link.transform)
        else:
            moving.add(link.child)
    path = known.path(parent, child)
    if path is None:
        raise EvaluationError(f"no transforms lead from {parent} to {child}; {_candidates(log)}")
    nearest = next((frame for frame in (*path[1], *reversed(path[0])) if frame in moving), None)
    for log_time, link, is_static in _links(log):
        if is_static:
            continue
        tree.add(link.parent, link.child, link.transform)
        if link.child == nearest and (transform := tree.lookup(parent, child)) is not None:
            yield link.stamp_ns or log_time, transform.to_pose2()


def _links(log: Log) -> Iterator[tuple[int, LinkMessage, bool]]:
    """(log time, transform, whether it is static) of all transforms, in the order of the log."""
    for topic, log_time, message in log.observations():
        if isinstance(message, list):
            for link in message:
                yield log_time, link, is_static_topic(topic)


def _candidates(log: Log) -> str:
    names = [
        name if name not in TF_NAMES else f"{TF}:map.{log.summary.base_frame or 'base_link'}"
        for name in log.summary.reference_candidates
    ]
    if not names:
        return "it holds no poses to compare with"
    return f"name a topic, as in LOG:{names[0]}; it has {', '.join(names)}"
