"""The way of a topic's messages: decoded, and made into events by a feed; many at once where they are alike."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hsloc.log.messages.decoders import Undecodable, column_decoder_for
from hsloc.log.session.event_builders import OdometryFeed
from hsloc.log.session.ordering import Arrivals

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from hsloc.log.container import Channel, RawMessage
    from hsloc.log.messages.cdr_batch_decode import ColumnDecoder
    from hsloc.log.messages.decoders import Decoder
    from hsloc.log.session.event_builders import Feed
    from hsloc.log.session.ordering import TopicClock
    from hsloc.log.summary import Losses
    from hsloc.model import Event

_FEW = 4
"""Number of messages up to which they are decoded one by one. Internal: time alone, the events are the same."""


class Route:
    """A feed, and the channels that lead to it with their decoders.

    A feed that keeps something from one message to the next (`TransformFeed`) must see them in the order of the log,
    whichever of the topic's channels they come by: each publisher may have its own.
    """

    def __init__(self, feed: Feed, channels: Mapping[int, tuple[Channel, Decoder]]) -> None:
        """The channels by the keys that messages carry."""
        self._feed = feed
        self._decoders = {key: decoder for key, (_, decoder) in channels.items()}
        self._columns: dict[int, ColumnDecoder] = {}
        if isinstance(feed, OdometryFeed):
            found = ((key, column_decoder_for(channel)) for key, (channel, _) in channels.items())
            self._columns = {key: decoder for key, decoder in found if decoder is not None}

    def read(self, messages: Sequence[RawMessage], places: Sequence[int], losses: Losses) -> Sequence[Arrivals]:
        """The events of messages, which have these places in their batch; what cannot be decoded is counted."""
        if self._columns and isinstance(self._feed, OdometryFeed) and len(messages) > _FEW:
            first = messages[0][2]
            decoder = self._columns.get(first)
            if decoder is not None and all(message[2] == first for message in messages):
                columns = decoder([message[3] for message in messages], covariances=not self._feed.is_truth)
                if columns is not None:
                    arrivals = self._feed.arrivals(columns, places, [message[0] for message in messages])
                    if arrivals is not None:
                        return (arrivals,)
        return self._one_by_one(messages, places, losses)

    def _one_by_one(self, messages: Sequence[RawMessage], places: Sequence[int], losses: Losses) -> Sequence[Arrivals]:
        found: dict[TopicClock, list[tuple[int, int, int, Event]]] = {}
        feed, decoders = self._feed, self._decoders
        for place, (log_time, _, key, data) in zip(places, messages, strict=True):
            try:
                message = decoders[key](data)
            except Undecodable as error:
                losses.undecodable_messages[feed.topic] += 1
                losses.note(f"{feed.topic}: a message cannot be decoded ({error})")
                continue
            for clock, event in feed.events(message, log_time):
                found.setdefault(clock, []).append((place, log_time, event.stamp_ns, event))
        return [Arrivals(clock, *zip(*rows, strict=True)) for clock, rows in found.items()]
