"""Which decoder a channel gets."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from hsloc.errors import LogFormatError
from hsloc.log.messages import cdr_batch_decode as columns
from hsloc.log.messages import decode, definitions, foxglove
from hsloc.log.messages import definition_compatibility as schema
from hsloc.log.messages.definitions import long_name

if TYPE_CHECKING:
    from collections.abc import Callable

    from hsloc.log.container import Channel
    from hsloc.log.messages.cdr_batch_decode import ColumnDecoder
    from hsloc.log.messages.decode import Payload

    Decoder = Callable[[Payload], Any]

_ALIASES = {"tf/msg/tfMessage": definitions.TF_MESSAGE} | foxglove.TYPES
"""ROS 1's old name of a type that is otherwise the same, and Foxglove's types."""


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
    return channel.message_encoding in ("cdr", "ros1") and canonical_type(channel.typename) in decode.BY_HAND


def decoder_for(channel: Channel) -> Decoder:
    """A function from payload to one of the tuples of `hsloc.log.messages.decode`; it raises `Undecodable` alone.

    Raises LogFormatError where the channel's definition cannot be used.
    """
    if foxglove.is_foxglove(channel):
        return _by_foxglove(channel)
    typename = canonical_type(channel.typename)
    if channel.message_encoding == "cdr" and _is_known(channel, typename):
        return _by_hand(channel, typename)
    return _by_rosbags(channel, typename)


def column_decoder_for(channel: Channel) -> ColumnDecoder | None:
    """A decoder of many messages with poses at once; None where the channel's are decoded one by one."""
    typename = canonical_type(channel.typename)
    if channel.message_encoding != "cdr" or foxglove.is_foxglove(channel) or not _is_known(channel, typename):
        return None
    return columns.BY_HAND.get(typename)


def _is_known(channel: Channel, typename: str) -> bool:
    if not channel.schema.strip():
        # Recorders leave it out when they cannot find the package; the name then has to stand for the type.
        return True
    if channel.schema_encoding != "ros2msg":
        return False
    return schema.is_known(channel.schema.decode(errors="replace"), typename)


def _by_hand(channel: Channel, typename: str) -> Decoder:
    fast = decode.BY_HAND[typename]
    slow: list[Decoder] = []

    def decoder(data: Payload) -> Any:
        try:
            return fast(data)
        except decode.BAD_PAYLOAD as error:
            if data[:2] != b"\x00\x00":
                raise Undecodable(str(error)) from error
        # Big endian: rare enough for the slow way.
        if not slow:
            slow.append(_by_rosbags(channel, typename))
        return slow[0](data)

    return decoder


def _by_foxglove(channel: Channel) -> Decoder:
    read = foxglove.decoder(channel)

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
    reason = schema.refusal(text, encoding)
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
    convert = decode.FROM_OBJECT[typename]

    def decoder(data: Payload) -> Any:
        try:
            return convert(deserialise(data, name))
        except Exception as error:  # As above.
            raise Undecodable(_short(error)) from error

    return decoder


def _short(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".splitlines()[0][:120]
