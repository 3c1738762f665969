"""Recordings: `open_log` gives events of the model from MCAP, ROS bags and text logs, `LogWriter` writes MCAP.

What is listed here is the public face of the package; nothing else of it is imported from outside. Names are imported
when they are first used: whoever needs `ReadOptions` alone does not wait for the readers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hsloc.lazy import lazy_names

if TYPE_CHECKING:
    from hsloc.log.checks.checker import CheckReport, check_log
    from hsloc.log.checks.findings import Finding, Severity
    from hsloc.log.checks.profile import Profile, read_profile, violations
    from hsloc.log.checks.topics import LEAST_JUMP, LONGEST_JUMP_S, MAX_SPEED
    from hsloc.log.convert import Conversion, convert_log
    from hsloc.log.mcap.ranges import copy_needed
    from hsloc.log.messages.decode import LinkMessage
    from hsloc.log.messages.encode import Marker
    from hsloc.log.reader import Log, is_log, open_log
    from hsloc.log.session.extrinsics import read_calibration
    from hsloc.log.session.topic_selection import TF, TF_NAMES
    from hsloc.log.session.transform_topics import is_static_topic
    from hsloc.log.summary import LONGEST_OFFSET_S, LaserSummary, LogSummary, Losses, ReadOptions
    from hsloc.log.transforms import FrameTree, Transform3, laser_mounting
    from hsloc.log.writer import LogWriter

__all__ = [
    "LEAST_JUMP",
    "LONGEST_JUMP_S",
    "LONGEST_OFFSET_S",
    "MAX_SPEED",
    "TF",
    "TF_NAMES",
    "CheckReport",
    "Conversion",
    "Finding",
    "FrameTree",
    "LaserSummary",
    "LinkMessage",
    "Log",
    "LogSummary",
    "LogWriter",
    "Losses",
    "Marker",
    "Profile",
    "ReadOptions",
    "Severity",
    "Transform3",
    "check_log",
    "convert_log",
    "copy_needed",
    "is_log",
    "is_static_topic",
    "laser_mounting",
    "open_log",
    "read_calibration",
    "read_profile",
    "violations",
]

_MODULES = {
    "checks.checker": ("CheckReport", "check_log"),
    "checks.findings": ("Finding", "Severity"),
    "checks.profile": ("Profile", "read_profile", "violations"),
    "checks.topics": ("LEAST_JUMP", "LONGEST_JUMP_S", "MAX_SPEED"),
    "convert": ("Conversion", "convert_log"),
    "mcap.ranges": ("copy_needed",),
    "messages.decode": ("LinkMessage",),
    "messages.encode": ("Marker",),
    "reader": ("Log", "is_log", "open_log"),
    "session.extrinsics": ("read_calibration",),
    "session.topic_selection": ("TF", "TF_NAMES"),
    "session.transform_topics": ("is_static_topic",),
    "summary": ("LONGEST_OFFSET_S", "LaserSummary", "LogSummary", "Losses", "ReadOptions"),
    "transforms": ("FrameTree", "Transform3", "laser_mounting"),
    "writer": ("LogWriter",),
}
__getattr__, __dir__ = lazy_names(
    __name__, {name: f"hsloc.log.{module}" for module, names in _MODULES.items() for name in names}
)
