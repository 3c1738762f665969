"""Message definitions that a log carries: are they the ones we know, and may they be handed to a parser?"""

from __future__ import annotations

import re

from hsloc.log.messages import definitions
from hsloc.log.messages.definitions import short_name

MAX_SCHEMA_BYTES = 64 << 10
"""Maximum size of a definition that is parsed. Internal: guards the time against a hostile file."""
MAX_ARRAY = 4096
"""Longest fixed array in a definition that is not ours: the parser unrolls them."""

_SEPARATOR = re.compile(r"^=+\s*$", re.MULTILINE)
_BUILTIN = re.compile(r"(bool|byte|char|float(32|64)|u?int(8|16|32|64)|w?string|time|duration)(<=\d+)?")

Fields = tuple[tuple[str, str], ...]
"""(type, name) of each field, in order."""


def parse_fields(text: str, package: str) -> Fields:
    """Fields of one definition; comments, constants and default values are left out."""
    fields = []
    for line in text.splitlines():
        words = line.partition("#")[0].split()
        if len(words) < 2 or "=" in words[1] or (len(words) > 2 and words[2].startswith("=")):
            continue
        kind, bracket, bounds = words[0].partition("[")
        if kind == "Header":
            kind = "std_msgs/Header"
        elif "/" not in kind and not _BUILTIN.fullmatch(kind):
            kind = f"{package}/{kind}"
        fields.append((short_name(kind) + bracket + bounds, words[1]))
    return tuple(fields)


def parse_definition(text: str, typename: str) -> dict[str, Fields]:
    """All types of a `ros2msg` or `ros1msg` text, the main one under its own name."""
    parts = _SEPARATOR.split(text)
    main = short_name(typename)
    found = {main: parse_fields(parts[0], main.partition("/")[0])}
    for part in parts[1:]:
        head, _, body = part.strip().partition("\n")
        if head.startswith("MSG:"):
            name = short_name(head[4:].strip())
            found.setdefault(name, parse_fields(body, name.partition("/")[0]))
    return found


_KNOWN = {name: parse_fields("\n".join(fields), name.partition("/")[0]) for name, fields in definitions.FIELDS.items()}


def is_known(text: str, typename: str) -> bool:
    """Whether a `ros2msg` text defines exactly the fields of the type that we decode by hand.

    Comments, spaces and the order of the parts do not matter; every field's type and name do.
    """
    if len(text) > MAX_SCHEMA_BYTES or short_name(typename) not in _KNOWN:
        return False
    found = parse_definition(text, typename)
    pending, seen = [short_name(typename)], set()
    while pending:
        name = pending.pop()
        if name in seen:
            continue
        seen.add(name)
        if found.get(name) != _KNOWN[name]:
            return False
        # The fields are the known ones, and so every name in them is known as well.
        pending += [kind.partition("[")[0] for kind, _ in _KNOWN[name] if "/" in kind]
    return True


def is_incomplete(text: str, typename: str, is_ros1: bool = False) -> bool:
    """Whether a definition of a standard type says less than the standard one, and nothing else.

    Some recorders write the type's name in place of its definition, or leave out the definitions of the types within.
    In ROS 1 a header has a sequence number, which ROS 2 has not.
    """
    name = short_name(typename)
    if len(text) > MAX_SCHEMA_BYTES or name not in _KNOWN:
        return False
    bare = text.strip()
    if bare in ("", name, typename, name.rpartition("/")[2]):
        return True
    found = parse_definition(text, typename)
    for part, fields in found.items():
        known = _KNOWN.get(part)
        if known is None:
            return False
        if part == "std_msgs/Header" and is_ros1:
            fields = tuple(field for field in fields if field[1] != "seq")
            known = tuple((kind, field) for kind, field in known)
        if [field for _, field in fields] != [field for _, field in known]:
            return False
    needed, seen = [name], set()
    while needed:
        part = needed.pop()
        if part in seen:
            continue
        seen.add(part)
        needed += [kind.partition("[")[0] for kind, _ in _KNOWN[part] if "/" in kind]
    return not seen - {"builtin_interfaces/Time"} <= found.keys()


def refusal(text: str, encoding: str) -> str | None:
    """Why a definition must not be handed to the parser of rosbags, or None.

    Some short texts cost it minutes or gigabytes: long arrays (it unrolls them), nested brackets and shifts in
    constants of IDL (exponential, or unbounded).
    """
    if len(text) > MAX_SCHEMA_BYTES:
        return f"its definition has {len(text)} characters, at most {MAX_SCHEMA_BYTES} are read"
    for number in re.findall(r"[\[,<]\s*=?\s*(\d+)\s*[\]>]", text):
        if len(number) > 6 or int(number) > MAX_ARRAY:
            return f"its definition has an array of {number[:20]} elements"
    if encoding == "ros2idl" and re.search(r"<<|\bconst\b[^;]*\(", text):
        return "its definition computes constants"
    return None
