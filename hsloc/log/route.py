"""The way of one channel's messages: decoded, and made into events by a feed; many at once where they are alike."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hsloc.log.decoders import Undecodable, column_decoder_for
from hsloc.log.feeds import OdometryFeed
from hsloc.log.ordering import Arrivals

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hsloc.log.container import Channel, RawMessage
    from hsloc.log.decoders import Decoder
    from hsloc.log.feeds import Feed
    from hsloc.log.ordering import TopicClock
    from hsloc.log.summary import Losses
    from hsloc.model import Event

_FEW = 4
"""Messages that are rather decoded one by one."""


class Route:
    """A channel, its decoder and its feed."""

    def __init__(self, feed: Feed, decoder: Decoder, channel: Channel) -> None:
        self._feed = feed
        self._decoder = decoder
        self._columns = column_decoder_for(channel) if isinstance(feed, OdometryFeed) else None

    def read(self, messages: Sequence[RawMessage], places: Sequence[int], losses: Losses) -> Sequence[Arrivals]:
        """The events of messages, which have these places in their batch; what cannot be decoded is counted."""
        if self._columns is not None and isinstance(self._feed, OdometryFeed) and len(messages) > _FEW:
            payloads = [message[3] for message in messages]
            columns = self._columns(payloads, covariances=not self._feed.is_truth)
            if columns is not None:
                arrivals = self._feed.arrivals(columns, places, [message[0] for message in messages])
                if arrivals is not None:
                    return (arrivals,)
        return self._one_by_one(messages, places, losses)

    def _one_by_one(self, messages: Sequence[RawMessage], places: Sequence[int], losses: Losses) -> Sequence[Arrivals]:
        found: dict[TopicClock, list[tuple[int, int, int, Event]]] = {}
        feed, decoder = self._feed, self._decoder
        for place, (log_time, _, _, data) in zip(places, messages, strict=True):
            try:
                message = decoder(data)
            except Undecodable as error:
                losses.undecodable_messages[feed.topic] += 1
                losses.note(f"{feed.topic}: a message cannot be decoded ({error})")
                continue
            for clock, event in feed.events(message, log_time):
                found.setdefault(clock, []).append((place, log_time, event.stamp_ns, event))
        return [Arrivals(clock, *zip(*rows, strict=True)) for clock, rows in found.items()]
