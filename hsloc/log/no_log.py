"""What a file is that is no log, by how it begins, and what to do about it."""

from __future__ import annotations

import os
import re
from itertools import islice
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

NO_LOG = (
    "is not an MCAP, a ROS bag or a CARMEN log; name the recording: a .mcap, .db3 or .bag file, a CARMEN or Wean Hall "
    "text, or the folder with its parts"
)
EMPTY = "is empty (0 bytes); copy it again, or record again"
COPY_AGAIN = "copy the file again, if the copy was cut off"
_SQLITE_PAGE_AT, _SQLITE_PAGES_AT = 16, 28
_MAX_FOLDERS = 1000
"""Folders that are looked into below one without a log."""

_FOREIGN = {
    b"7z\xbc\xaf\x27\x1c": "7z",
    b"Rar!": "rar",
    b"\x1f\x9d": "compress (.Z)",
    b"\x89LZO": "lzop",
    b"LZIP": "lzip",
    b"\xff\x06\x00\x00sNaPpY": "snappy",
}
"""How files begin that are packed in a way that is not read, and its name."""
_WAL = (b"\x37\x7f\x06\x82", b"\x37\x7f\x06\x83")
"""How the write-ahead log of an SQLite database begins."""
_IMAGE = re.compile(rb"\x89PNG|\xff\xd8\xff|GIF8|BM.{4}\0\0\0\0|II\*\0|MM\0\*|RIFF.{4}WEBP|P[1-7]\s+(#|\d)", re.DOTALL)
"""How images begin: PNG, JPEG, GIF, BMP, TIFF, WebP, and PGM with its relatives."""
_MAP = re.compile(rb"^image\s*:", re.MULTILINE), re.compile(rb"^resolution\s*:", re.MULTILINE)
"""Lines of the YAML of a map."""


def why_no_log(path: Path, head: bytes) -> str:
    """What a file is that begins with `head` and is no log, and what to do: the end of a message."""
    packed = next((name for magic, name in _FOREIGN.items() if head.startswith(magic)), None)
    if packed is not None:
        return f"is packed by {packed}, which is not read; unpack it first"
    if head.startswith(_WAL):
        name = path.name.removesuffix("-wal")
        return f"is the write-ahead log of a ROS 2 bag: name the database, {name}, which must lie beside it"
    if _IMAGE.match(head):
        return "is an image, not a log; name the recording, and give a map by its .yaml with --map"
    if all(line.search(head) for line in _MAP):
        return "is the YAML of a map, not a log; name the recording, and give the map with --map"
    return NO_LOG


def no_logs_inside(folder: Path, is_log: Callable[[str], bool]) -> str:
    """The end of the message for a folder without a log: names the folders below that hold one by the name."""
    walk = ((inside, names) for inside, _, names in islice(os.walk(folder), _MAX_FOLDERS))
    found = sorted(inside for inside, names in walk if any(is_log(name) for name in names))
    if not found:
        return "is a folder without .mcap, .db3 or .bag files; name a log file"
    more = f" ({len(found)} folders have some)" if len(found) > 1 else ""
    what = "is a folder without .mcap, .db3 or .bag files, which lie further down"
    return f"{what}; name the folder of one recording, such as {found[0]}{more}"


def missing_of_database(path: Path) -> str:
    """How much of an SQLite database is missing by what its head says, for a message; empty where nothing is."""
    try:
        with path.open("rb") as stream:
            head = stream.read(_SQLITE_PAGES_AT + 4)
        size = path.stat().st_size
    except OSError:
        return ""
    page = int.from_bytes(head[_SQLITE_PAGE_AT : _SQLITE_PAGE_AT + 2], "big")
    stated = (65536 if page == 1 else page) * int.from_bytes(head[_SQLITE_PAGES_AT:], "big")
    return f"{stated - size} of its {stated} bytes are missing, and it " if size < stated else ""
