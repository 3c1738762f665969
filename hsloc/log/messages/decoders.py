"""Which decoder a channel gets, by the message definitions that the log carries.

Are they the definitions we know, and may they be handed to a parser?
"""

from __future__ import annotations

import dataclasses
import io
import re
from typing import IO, TYPE_CHECKING, Any, cast

from hsloc.errors import LogFormatError
from hsloc.log.messages import cdr_batch_decode as columns
from hsloc.log.messages import decode, definitions, foxglove, from_objects, odometry_kinds, point_cloud
from hsloc.log.messages.definitions import long_name, short_name
from hsloc.log.packing import STREAMS, ZSTD, opened
from hsloc.warnings import RunWarning, WarningCode

if TYPE_CHECKING:
    from collections.abc import Callable

    from hsloc.log.container import Channel
    from hsloc.log.messages.cdr_batch_decode import ColumnDecoder
    from hsloc.log.messages.decode import Payload

    Decoder = Callable[[Payload], Any]

_ALIASES = {"tf/msg/tfMessage": definitions.TF_MESSAGE} | foxglove.TYPES
"""ROS 1's old name of a type that is otherwise the same, and Foxglove's types."""

BY_HAND = decode.BY_HAND | {definitions.POINT_CLOUD2: point_cloud.point_cloud}
FROM_OBJECT = {
    **from_objects.FROM_OBJECT,
    definitions.POINT_CLOUD2: point_cloud.object_point_cloud,
    **{kind.typename: kind.from_object for kind in odometry_kinds.ODOMETRY_KINDS},
}
_ENCODINGS = {
    **{name: name for name in ("cdr", "ros1", "json")},
    **dict.fromkeys(("cdr_le", "cdr2", "xcdr", "xcdr1", "xcdr2", "ros2"), "cdr"),
    **dict.fromkeys(("application/json", "text/json", "rosjson"), "json"),
    "ros1msg": "ros1",
}
"""Encodings of messages that are read, by the names that recorders write in small letters."""
_MAX_UNPACKED_BYTES = 256 << 20
"""Largest size of a payload that was compressed by itself (rosbag2's `--compression-mode message`)."""
_LONGEST_MAGIC = max(map(len, STREAMS))

MAX_SCHEMA_BYTES = 64 << 10
"""Maximum size of a definition that is parsed. Internal: guards the time against a hostile file."""
MAX_ARRAY = 4096
"""Longest fixed array in a definition that is not ours: the parser unrolls them."""
_SEPARATOR = re.compile(r"^=+\s*$", re.MULTILINE)
_SEQUENCE = re.compile(rb"^\s*uint32\s+seq\s*(#.*)?$", re.MULTILINE)
_BUILTIN = re.compile(r"(bool|byte|char|float(32|64)|u?int(8|16|32|64)|w?string|time|duration)(<=\d+)?")
Fields = tuple[tuple[str, str], ...]
"""(type, name) of each field, in order."""


class Undecodable(Exception):
    """A payload that is not what its channel says. Internal: the reader counts it."""


def canonical_type(typename: str) -> str:
    """The type's name in ROS 2, whatever the log calls it."""
    name = long_name(typename)
    return _ALIASES.get(name, name)


def is_decodable(channel: Channel) -> bool:
    """Whether hsloc has a decoder for the channel's type and encoding."""
    if channel.typename.startswith(foxglove.PREFIX):
        return foxglove.is_foxglove(channel)
    return channel.message_encoding.lower() in _ENCODINGS and is_read(channel)


def is_read(channel: Channel) -> bool:
    """Whether the channel's type is one that hsloc reads, however its messages are encoded."""
    return canonical_type(channel.typename) in FROM_OBJECT


def decoder_for(channel: Channel, warnings: list[RunWarning] | None = None) -> Decoder:
    """A function from payload to one of the tuples of `hsloc.log.messages.decode`; it raises `Undecodable` alone.

    Payloads that are compressed by themselves are unpacked, and JSON is read whatever the channel calls it. A
    definition of a standard type that is incomplete is replaced by the standard one, which is added to `warnings`.
    Raises LogFormatError where the channel's definition cannot be used.
    """
    if foxglove.is_foxglove(channel):
        plain = _guarded(foxglove.decoder(channel))
    else:
        plain = _ros_decoder(_normalised(channel), warnings)

    def decoder(data: Payload) -> Any:
        try:
            return plain(data)
        except Undecodable:
            if bytes(data[:_LONGEST_MAGIC]).startswith(STREAMS):  # CDR begins with a zero, JSON with a brace.
                return plain(_unpacked(bytes(data)))
            if bytes(data[:1]) == b"{" and _ENCODINGS.get(channel.message_encoding.lower()) == "cdr":
                return _guarded(from_objects.json_decoder(FROM_OBJECT[canonical_type(channel.typename)]))(data)
            raise

    return decoder


_SCHEMAS = ("ros2msg", "ros1msg", "ros2idl", "jsonschema")
_IDL = re.compile(r"^\s*(IDL:|module\s|#include)", re.MULTILINE)


def _normalised(channel: Channel) -> Channel:
    """The channel with the encodings of its messages and its definition under the names that hsloc knows."""
    text = channel.schema.decode(errors="replace").removeprefix("\ufeff")
    form = channel.schema_encoding.lower()
    if form == "ros2idl" and text.strip() and not _IDL.search(text):
        form = "ros2msg"
    return dataclasses.replace(
        channel,
        message_encoding=_ENCODINGS.get(channel.message_encoding.lower(), channel.message_encoding),
        schema_encoding=form if form in _SCHEMAS or not text.strip() else "ros2idl" if _IDL.search(text) else "",
        schema=text.encode(),
    )


def _ros_decoder(channel: Channel, warnings: list[RunWarning] | None) -> Decoder:
    typename = canonical_type(channel.typename)
    if channel.message_encoding == "json":
        return _guarded(from_objects.json_decoder(FROM_OBJECT[typename]))
    if typename not in BY_HAND and not (channel.message_encoding == "ros1" or channel.schema.strip()):
        channel = dataclasses.replace(channel, schema_encoding="")
    elif channel.message_encoding == "cdr" and typename in BY_HAND:
        if _is_known(channel, typename):
            return _by_hand(channel, typename)
        if (without := _without_sequence(channel)) is not None and _is_known(without, typename):
            return _by_hand(channel, typename, is_sure=False)
    if _is_incomplete(channel, typename):
        if warnings is not None:
            text = (
                f"{channel.topic}: the log's definition of {channel.typename} is incomplete; the standard one is used"
            )
            warnings.append(RunWarning(WarningCode.DEFINITION_INCOMPLETE, text))
        channel = dataclasses.replace(channel, schema=b"", schema_encoding="")
        by_hand = channel.message_encoding == "cdr" and typename in BY_HAND
        return _by_hand(channel, typename) if by_hand else _by_rosbags(channel, typename)
    return _by_rosbags(channel, typename)


def column_decoder_for(channel: Channel) -> ColumnDecoder | None:
    """A decoder of many messages with poses at once; None where the channel's are decoded one by one."""
    typename = canonical_type(channel.typename)
    if foxglove.is_foxglove(channel):
        return None
    channel = _normalised(channel)
    if channel.message_encoding != "cdr" or not _is_known(channel, typename):
        return None
    return columns.BY_HAND.get(typename)


def _is_known(channel: Channel, typename: str) -> bool:
    if not channel.schema.strip():
        # Recorders leave it out when they cannot find the package; the name then has to stand for the type.
        return True
    if channel.schema_encoding != "ros2msg":
        return False
    return is_known(channel.schema.decode(errors="replace"), typename)


def _without_sequence(channel: Channel) -> Channel | None:
    """The channel without the number that ROS 1 has in its headers; None where its definition has none.

    Converters from ROS 1 to ROS 2 leave it in the definition, although CDR has no such number.
    """
    text = _SEQUENCE.sub(b"", channel.schema)
    return dataclasses.replace(channel, schema=text) if text != channel.schema else None


def _is_incomplete(channel: Channel, typename: str) -> bool:
    """Whether a definition says nothing against the standard one: it is empty, a mere name, or lacks its parts."""
    text = channel.schema.decode(errors="replace")
    if channel.schema_encoding not in ("ros2msg", "ros1msg", "") or refusal(text, channel.schema_encoding):
        return False
    return is_incomplete(text, typename, channel.message_encoding == "ros1")


def _by_hand(channel: Channel, typename: str, *, is_sure: bool = True) -> Decoder:
    """The decoder made for the type; big endian goes to rosbags, and all that it cannot read unless it `is_sure`."""
    fast = BY_HAND[typename]
    slow: list[Decoder] = []

    def decoder(data: Payload) -> Any:
        try:
            return fast(data)
        except decode.BAD_PAYLOAD as error:
            if is_sure and data[:2] != decode.BIG_ENDIAN:
                raise Undecodable(str(error)) from error
        # Rare enough for the slow way.
        if not slow:
            slow.append(_by_rosbags(channel, typename))
        return slow[0](data)

    return decoder


def _unpacked(data: bytes) -> bytes:
    """A payload that was compressed by itself, as `STREAMS` begin."""
    try:
        with _unpacking(data) as stream:
            found = stream.read(_MAX_UNPACKED_BYTES + 1)
    except Exception as error:  # Each library has errors of its own.
        raise Undecodable(f"its compression is damaged ({_short(error)})") from error
    if len(found) > _MAX_UNPACKED_BYTES or found.startswith(STREAMS):
        raise Undecodable(f"unpacks to more than {_MAX_UNPACKED_BYTES >> 20} MB, or is packed twice")
    return found


def _unpacking(data: bytes) -> IO[bytes]:
    if not data.startswith(ZSTD):
        return opened(io.BytesIO(data), data)
    import zstandard

    whole = zstandard.frame_content_size(data)
    if 0 <= whole <= _MAX_UNPACKED_BYTES:  # Unlike a stream's reader this one notices where the end is missing.
        return io.BytesIO(zstandard.ZstdDecompressor().decompress(data))
    return cast("IO[bytes]", zstandard.ZstdDecompressor().stream_reader(data))


def _guarded(read: Callable[[Payload], Any]) -> Decoder:
    def decoder(data: Payload) -> Any:
        try:
            return read(data)
        except Exception as error:  # JSON and protobuf raise many things, down to RecursionError.
            raise Undecodable(_short(error)) from error

    return decoder


def _by_rosbags(channel: Channel, typename: str) -> Decoder:
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    name = long_name(channel.typename)
    text = channel.schema.decode(errors="replace")
    encoding = channel.schema_encoding or ("ros1msg" if channel.message_encoding == "ros1" else "ros2msg")
    reason = refusal(text, encoding)
    if reason:
        raise LogFormatError(f"{channel.topic}: {reason}; name another topic")
    try:
        if not text.strip():
            known = Stores.ROS1_NOETIC if channel.message_encoding == "ros1" else Stores.LATEST
            store = get_typestore(known)
        else:
            store = get_typestore(Stores.EMPTY)
            if encoding == "ros2idl":
                separator = "=" * 80 + "\n"
                parts = [part.partition("\n")[2] for part in text.split(separator) if part.startswith("IDL: ")]
                for part in parts or [text]:
                    store.register(get_types_from_idl(part))
            else:
                store.register(get_types_from_msg(text, name))
        store.get_msgdef(name)
    except Exception as error:  # The parser raises whatever its generated code does.
        raise LogFormatError(
            f"{channel.topic}: the definition of {name} cannot be used ({_short(error)}); name another topic"
        ) from error
    deserialise = store.deserialize_ros1 if channel.message_encoding == "ros1" else store.deserialize_cdr
    convert = FROM_OBJECT[typename]

    def decoder(data: Payload) -> Any:
        try:
            return convert(deserialise(data, name))
        except Exception as error:  # As above.
            raise Undecodable(_short(error)) from error

    return decoder


def _short(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".splitlines()[0][:120]


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
    package = name.partition("/")[0]
    if not any(_is_field(field, package) for field in found[name]):  # comments, or words that define nothing
        return True
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


def _is_field(field: tuple[str, str], package: str) -> bool:
    """Whether a line of a definition declares something: its type is built in, known, or of another package."""
    kind, name = field[0].partition("[")[0], field[1]
    return name.isidentifier() and (kind in _KNOWN or not kind.startswith(f"{package}/"))


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
