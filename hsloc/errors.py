"""One tree of errors. Each message is one line that names the file, the value and the remedy.

::

    HslocError                  anything reported to a user; the command line maps it to exit code 1
    ├── LogError                a log cannot be opened, or holds nothing that can be used
    │   ├── LogFormatError      not a log of a known format, or damaged beyond use
    │   └── TopicError          no scan or odometry topic, or several to choose from
    ├── MapError                a map cannot be read, or does not fit the log
    ├── ConfigError             an unknown key or a value outside its range
    ├── EvaluationError         trajectories that cannot be compared
    └── OutputError             results cannot be written

A failed match is not an error: it is an `Estimate` whose status says so.
"""

from __future__ import annotations

from difflib import get_close_matches
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path


class HslocError(Exception):
    """Base of all errors that hsloc raises on purpose."""


class LogError(HslocError):
    """A log cannot be opened or holds nothing that can be used."""


class LogFormatError(LogError):
    """The file is not a log of a known format, or it is damaged beyond use."""


class TopicError(LogError):
    """A topic is missing, or several could be meant."""


class MapError(HslocError):
    """A map cannot be read, or does not fit the log."""


class ConfigError(HslocError):
    """A configuration has an unknown key or a value outside its range."""


class EvaluationError(HslocError):
    """Two trajectories cannot be compared."""


class OutputError(HslocError):
    """Results cannot be written."""


def install_hint(*extras: str) -> str:
    """How packages come that hsloc works without, in a clone and elsewhere; hsloc itself is there already."""
    names = ",".join(extras)
    return f"pip install '.[{names}]' in a clone of hsloc, pip install 'hsloc[{names}]' elsewhere"


def not_written(path: object, error: OSError) -> str:
    """The message for a file or folder that cannot be written."""
    reason = f"{path}: cannot be written ({error.strerror or error})"
    return f"{reason}; check the folder, its rights and free space, or name another one"


def not_read(path: object, error: OSError) -> str:
    """The message for a file or folder that is there and cannot be read."""
    denied = isinstance(error, PermissionError)
    remedy = "check its rights, and those of the folders above it" if denied else "check the path and its disk"
    return f"{path}: cannot be read ({error.strerror or error}); {remedy}"


def _stem(name: str) -> str:
    """A name without its endings: alike for these alone, no two files are alike."""
    return name.partition(".")[0]


def no_such(path: Path, what: str = "file", remedy: str = "; check the path") -> str:
    """The message for a path that does not exist: names a similar file beside it, else the remedy."""
    try:
        names = [each.name for each in path.parent.iterdir()]
    except OSError:
        names = []
    close = [each for each in get_close_matches(path.name, names) if get_close_matches(_stem(path.name), [_stem(each)])]
    return f"{path}: no such {what}" + (f"; did you mean {path.parent / close[0]}?" if close else remedy)
